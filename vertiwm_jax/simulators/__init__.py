"""Simulators outside jit, which move one vehicle at a time; recording of drives, and tasks."""
