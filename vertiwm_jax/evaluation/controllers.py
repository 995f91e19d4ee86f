"""Policies that learn nothing: the rows beside every learned one."""

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.env.navigation import NavigationConfig
from vertiwm_jax.env.observation import GOAL
from vertiwm_jax.evaluation.navigation import Policy
from vertiwm_jax.state import Command

REFERENCE = "straight to goal"
"""The baseline whose failures tell which tasks are hard."""


def baselines(config: NavigationConfig) -> dict[str, Policy]:
    """The policies of this file, by the names of their rows in a table."""
    return {REFERENCE: StraightToGoal(config), "random": RandomActions()}


@struct.dataclass
class StraightToGoal:
    """Holds one speed and steers at the goal, blind to the ground.

    config: of the environment, which says what actions mean.
    speed: m/s. gain: steering angle for each rad of bearing.
    """

    config: NavigationConfig = struct.field(pytree_node=False)
    speed: float = 4.0
    gain: float = 1.0

    def __call__(self, observation: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """`[..., O]` observation to `[..., 2]` action; the key is not used."""
        _, cos, sin = jnp.moveaxis(observation[..., GOAL], -1, 0)
        steering = self.gain * jnp.arctan2(sin, cos)
        return self.config.action(Command(jnp.full_like(steering, self.speed), steering))


@struct.dataclass
class RandomActions:
    """A new action at every step, uniform in [-1, 1]^2."""

    def __call__(self, observation: jax.Array, key: jax.Array) -> jax.Array:
        """`[..., O]` observation to `[..., 2]` action."""
        return jax.random.uniform(key, (*observation.shape[:-1], 2), minval=-1.0, maxval=1.0)
