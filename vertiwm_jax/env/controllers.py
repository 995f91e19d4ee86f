"""Policies that learn nothing: the rows beside every learned one."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.env.agent import Policy
from vertiwm_jax.env.observation import ARC_STATIONS, ARC_STEERING, GOAL, ROUTE_SCALE, arcs_ahead
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.traversability import TraversabilityCost
from vertiwm_jax.mechanics.vehicle import Vehicle, hmmwv

REFERENCE = "straight to goal"
"""The baseline whose failures tell which tasks are hard."""


def baselines(config: NavigationConfig, vehicle: Vehicle) -> dict[str, Policy]:
    """The policies of this file, by the names of their rows in a table."""
    return {
        "look ahead": LookAhead(config),
        REFERENCE: StraightToGoal(config, float(vehicle.steering_limit)),
        "random": RandomActions(),
    }


@struct.dataclass
class StraightToGoal:
    """Holds one speed and steers at the goal, blind to the ground.

    config: of the environment, which says what actions mean; steering_limit: of the vehicle, rad.
    speed: m/s. gain: steering angle for each rad of bearing.
    """

    config: NavigationConfig = struct.field(pytree_node=False)
    steering_limit: float = struct.field(
        pytree_node=False, default_factory=lambda: float(hmmwv().steering_limit)
    )
    speed: float = 4.0
    gain: float = 1.0

    def __call__(self, observation: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """`[..., O]` observation to `[..., 2]` action; the key is not used."""
        _, cos, sin = jnp.moveaxis(observation[..., GOAL], -1, 0)
        steering = self.gain * jnp.arctan2(sin, cos) / self.steering_limit
        return _at_speed(self.config, self.speed, steering)


@struct.dataclass
class LookAhead:
    """Holds one speed and steers along the arc that keeps level and leads on to the goal.

    The cost of an arc is how hard the ground on it is, near places first, and what the way to the
    goal costs from its far places; the steering is the mean over arcs, weighed by
    exp(-cost / spread).

    config: of the environment. speed: m/s. reach: wheelbases over which places lose weight.
    onward: weight of each metre that is left to go. far: stations from which that is told.
    """

    config: NavigationConfig = struct.field(pytree_node=False)
    speed: float = struct.field(pytree_node=False, default=4.0)
    difficulty: TraversabilityCost = struct.field(pytree_node=False, default=TraversabilityCost())
    reach: float = struct.field(pytree_node=False, default=2.7)
    onward: float = struct.field(pytree_node=False, default=0.15)
    far: tuple[int, int] = struct.field(pytree_node=False, default=(5, 7))
    spread: float = struct.field(pytree_node=False, default=0.4)

    def __call__(self, observation: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """`[..., O]` observation to `[..., 2]` action; the key is not used."""
        _, crown, rise, bank, twist, route = arcs_ahead(observation)
        hard = self.difficulty(crown, rise, bank, twist)
        cost = jnp.sum(hard * np.exp(-ARC_STATIONS / self.reach), axis=-1)
        left = ROUTE_SCALE * jnp.mean(route[..., slice(*self.far)], axis=-1)
        share = jax.nn.softmax(-(cost + self.onward * left) / self.spread, axis=-1)
        return _at_speed(self.config, self.speed, jnp.sum(share * ARC_STEERING, axis=-1))


@struct.dataclass
class RandomActions:
    """A new action at every step, uniform in [-1, 1]^2."""

    def __call__(self, observation: jax.Array, key: jax.Array) -> jax.Array:
        """`[..., O]` observation to `[..., 2]` action."""
        return jax.random.uniform(key, (*observation.shape[:-1], 2), minval=-1.0, maxval=1.0)


def _at_speed(config: NavigationConfig, speed: float, steering: jax.Array) -> jax.Array:
    """`[..., 2]` actions of a speed, m/s, and of a steering `[...]`, 1 at full lock."""
    low, high = config.speed_range
    action = jnp.stack(
        [jnp.full_like(steering, (speed - low) / (high - low) * 2 - 1), steering], -1
    )
    return jnp.clip(action, -1.0, 1.0)
