"""Sources of truth outside jit: one vehicle, one world, one step of 0.1 s at a time; recording."""
