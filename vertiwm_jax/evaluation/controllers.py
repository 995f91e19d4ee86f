"""Policies that learn nothing: the rows beside every learned one."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.env.driver import Policy
from vertiwm_jax.env.navigation import NavigationConfig
from vertiwm_jax.env.observation import ARC_STATIONS, ARC_STEERING, GOAL, arcs_ahead
from vertiwm_jax.geometry import wrap
from vertiwm_jax.state import Command

REFERENCE = "straight to goal"
"""The baseline whose failures tell which tasks are hard."""


def baselines(config: NavigationConfig) -> dict[str, Policy]:
    """The policies of this file, by the names of their rows in a table."""
    return {
        "look ahead": LookAhead(config),
        REFERENCE: StraightToGoal(config),
        "random": RandomActions(),
    }


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
class LookAhead:
    """Holds one speed and steers along the arc that keeps level and leads to the goal.

    The cost of an arc is what is too steep, twisted or crowned on it, near places first, and how
    far it turns from the goal; the steering is the mean over arcs, weighed by exp(-cost / spread).

    config: of the environment. speed: m/s. bank, rise, twist, crown, turn: weights of the cost.
    tolerated: bank and rise below it cost nothing, scaled as observed. reach: wheelbases over
    which places lose weight. turning: arc length, in wheelbases, that is compared to the bearing.
    """

    config: NavigationConfig = struct.field(pytree_node=False)
    speed: float = struct.field(pytree_node=False, default=4.0)
    bank: float = struct.field(pytree_node=False, default=1.0)
    rise: float = struct.field(pytree_node=False, default=1.45)
    twist: float = struct.field(pytree_node=False, default=2.3)
    crown: float = struct.field(pytree_node=False, default=1.1)
    turn: float = struct.field(pytree_node=False, default=2.2)
    tolerated: float = struct.field(pytree_node=False, default=0.4)
    spread: float = struct.field(pytree_node=False, default=0.4)
    reach: float = struct.field(pytree_node=False, default=2.7)
    turning: float = struct.field(pytree_node=False, default=1.2)

    def __call__(self, observation: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """`[..., O]` observation to `[..., 2]` action; the key is not used."""
        _, crown, rise, bank, twist = arcs_ahead(observation)
        cost = (
            self.bank * jnp.maximum(jnp.abs(bank) - self.tolerated, 0.0) ** 2
            + self.rise * jnp.maximum(jnp.abs(rise) - self.tolerated, 0.0) ** 2
            + self.twist * twist**2
            + self.crown * jnp.maximum(crown, 0.0) ** 2
        )
        cost = jnp.sum(cost * np.exp(-ARC_STATIONS / self.reach), axis=-1)
        _, cos, sin = jnp.moveaxis(observation[..., GOAL], -1, 0)
        turned = self.turning * np.tan(self.config.steering_limit * ARC_STEERING)
        off_goal = wrap(jnp.arctan2(sin, cos)[..., None] - turned)
        share = jax.nn.softmax(-(cost + self.turn * off_goal**2) / self.spread, axis=-1)
        steering = self.config.steering_limit * jnp.sum(share * ARC_STEERING, axis=-1)
        return self.config.action(Command(jnp.full_like(steering, self.speed), steering))


@struct.dataclass
class RandomActions:
    """A new action at every step, uniform in [-1, 1]^2."""

    def __call__(self, observation: jax.Array, key: jax.Array) -> jax.Array:
        """`[..., O]` observation to `[..., 2]` action."""
        return jax.random.uniform(key, (*observation.shape[:-1], 2), minval=-1.0, maxval=1.0)
