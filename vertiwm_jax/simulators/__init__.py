"""Sources of truth outside jit: one vehicle, one world, 0.1 s at a time; recording, and tasks."""
