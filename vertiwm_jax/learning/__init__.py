"""Recorded drives: reading them, cutting them into windows, fitting models to them."""
