"""Fast, differentiable world models for off-road reinforcement learning, in JAX."""

__version__ = "0.1.0"
