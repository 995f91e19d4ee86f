"""Fits models of a vehicle to its recorded drives: supervised learning.

What is learned here predicts how a vehicle moves. Policies, which decide what it does, are learned
in `vertiwm_jax.rl`.
"""
