"""Reads recorded drives, cuts them into windows, and fits models to them."""
