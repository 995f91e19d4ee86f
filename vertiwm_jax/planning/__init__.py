"""Agents that plan with a model: MPPI, gradient shooting, and a trained policy that looks ahead."""
