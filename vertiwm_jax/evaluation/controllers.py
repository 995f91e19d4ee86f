"""Policies that learn nothing: the rows beside every learned one."""

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.env.navigation import NavigationConfig
from vertiwm_jax.env.observation import GOAL
from vertiwm_jax.state import Command


@struct.dataclass
class StraightToGoal:
    """Holds one speed and steers at the goal, blind to the ground.

    config: of the environment, which says what actions mean.
    speed: m/s. gain: steering angle for each rad of bearing.
    """

    config: NavigationConfig = struct.field(pytree_node=False)
    speed: float = 4.0
    gain: float = 1.0

    def __call__(self, observation: jax.Array, key: jax.Array) -> jax.Array:
        """`[..., O]` observation to `[..., 2]` action."""
        _, cos, sin = jnp.moveaxis(observation[..., GOAL], -1, 0)
        steering = self.gain * jnp.arctan2(sin, cos)
        return self.config.action(Command(jnp.full_like(steering, self.speed), steering))


@struct.dataclass
class RandomActions:
    """A new action at every step, uniform in [-1, 1]^2."""

    def __call__(self, observation: jax.Array, key: jax.Array) -> jax.Array:
        """`[..., O]` observation to `[..., 2]` action."""
        return jax.random.uniform(key, (*observation.shape[:-1], 2), minval=-1.0, maxval=1.0)
