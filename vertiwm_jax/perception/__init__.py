"""The look at the ground: one function, `perceive` (Eq. 1)."""
