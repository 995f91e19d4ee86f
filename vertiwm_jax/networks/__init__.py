"""Neural networks, each by itself; `world_model` composes them."""
