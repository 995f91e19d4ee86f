"""Drives to look at: what a scene holds, and the recording or movie that shows it."""
