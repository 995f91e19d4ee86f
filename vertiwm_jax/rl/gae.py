"""Generalized advantage estimation that tells truncation from termination."""

import jax
import jax.numpy as jnp


def gae(
    rewards: jax.Array,
    values: jax.Array,
    next_values: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    discount: float,
    gae_lambda: float,
) -> jax.Array:
    """`[T, ...]` advantages, GAE(lambda) of Schulman et al. (2016), eq. 16.

    Args:
        rewards: `[T, ...]` of step t.
        values: `[T, ...]` V of the observation before step t.
        next_values: `[T, ...]` V of the observation after step t, before any automatic reset.
        terminated: `[T, ...]` bool, the task ended: what follows is worth nothing.
        truncated: `[T, ...]` bool, time ran out: what follows is worth `next_values`.
        discount: gamma.
        gae_lambda: lambda.
    """
    errors = rewards + discount * jnp.where(terminated, 0.0, next_values) - values
    decays = discount * gae_lambda * ~(terminated | truncated)

    def accumulate(following: jax.Array, inputs: tuple[jax.Array, jax.Array]):
        error, decay = inputs
        advantage = error + decay * following
        return advantage, advantage

    return jax.lax.scan(accumulate, jnp.zeros_like(values[0]), (errors, decays), reverse=True)[1]
