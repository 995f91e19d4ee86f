"""Reinforcement learning: algorithms compiled whole, and the host loop around them."""
