"""Hand-made controllers, which tables show beside learned policies."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.env.agent import Policy
from vertiwm_jax.env.observation import (
    ARC_STATIONS,
    ARC_STEERING,
    GOAL,
    ROUTE_SCALE,
    WAITING,
    WAITING_SCALE,
    arcs_ahead,
)
from vertiwm_jax.env.route import TraversabilityCost
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.mechanics.vehicle import Vehicle, load_vehicle
from vertiwm_jax.precision import float32

REFERENCE = "straight to goal"
"""The controller whose failures define which tasks are hard."""


def baselines(config: NavigationConfig, vehicle: Vehicle) -> dict[str, Policy]:
    """The controllers, by their names in tables; only *look ahead* needs the arcs ahead."""
    arcs: dict[str, Policy] = {"look ahead": LookAhead(config)} if config.arcs else {}
    return arcs | {
        REFERENCE: StraightToGoal(config, float(vehicle.steering_limit)),
        "random": RandomActions(),
    }


@struct.dataclass
class StraightToGoal:
    """Holds one speed and steers straight to the goal; ignores the ground.

    config: of the environment, which says what actions mean; steering_limit: of the vehicle, rad.
    speed: m/s. gain: steering angle for each rad of bearing.
    """

    config: NavigationConfig = struct.field(pytree_node=False)
    steering_limit: float = struct.field(
        pytree_node=False, default_factory=lambda: float(load_vehicle().steering_limit)
    )
    speed: float = 4.0
    gain: float = 1.0

    @float32
    def __call__(self, observation: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """`[..., O]` observation to `[..., 2]` action; the key is not used."""
        _, cos, sin = jnp.moveaxis(observation[..., GOAL], -1, 0)
        steering = self.gain * jnp.arctan2(sin, cos) / self.steering_limit
        return _at_speed(self.config, self.speed, steering)


@struct.dataclass
class LookAhead:
    """Holds one speed and steers along arcs that stay level and lead to the goal.

    The cost of an arc is the difficulty of its ground, near places first, plus the cost to go from
    its far places. The steering is the mean over arcs with weights exp(-cost / spread). Where the
    vehicle may reverse and has stalled, it backs up straight, as fast as it may, for a run-up.

    config: of the environment. speed: m/s. reach: wheelbases over which places lose weight.
    onward: weight of each meter of cost to go. far: stations whose cost to go is used.
    patience: seconds stalled before it backs up; run_up: seconds for which it does.
    """

    config: NavigationConfig = struct.field(pytree_node=False)
    speed: float = struct.field(pytree_node=False, default=4.0)
    difficulty: TraversabilityCost = struct.field(pytree_node=False, default=TraversabilityCost())
    reach: float = struct.field(pytree_node=False, default=2.7)
    onward: float = struct.field(pytree_node=False, default=0.15)
    far: tuple[int, int] = struct.field(pytree_node=False, default=(5, 7))
    spread: float = struct.field(pytree_node=False, default=0.4)
    patience: float = struct.field(pytree_node=False, default=1.0)
    run_up: float = struct.field(pytree_node=False, default=1.5)

    @float32
    def __call__(self, observation: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """`[..., O]` observation to `[..., 2]` action; the key is not used."""
        _, crown, rise, bank, twist, route = arcs_ahead(observation)
        hard = self.difficulty(crown, rise, bank, twist)
        cost = jnp.sum(hard * np.exp(-ARC_STATIONS / self.reach), axis=-1)
        left = ROUTE_SCALE * jnp.mean(route[..., slice(*self.far)], axis=-1)
        share = jax.nn.softmax(-(cost + self.onward * left) / self.spread, axis=-1)
        ahead = _at_speed(self.config, self.speed, jnp.sum(share * ARC_STEERING, axis=-1))
        if self.config.speed_range[0] >= 0:
            return ahead
        stalled, backing = jnp.moveaxis(observation[..., WAITING], -1, 0) * WAITING_SCALE
        # Both are whole steps of 0.1 s.
        begins = (backing < 0.05) & (stalled > self.patience - 0.05)
        goes_on = (backing > 0.05) & (backing < self.run_up - 0.05)
        return jnp.where((begins | goes_on)[..., None], jnp.array([-1.0, 0.0]), ahead)


@struct.dataclass
class RandomActions:
    """Draws a new action at every step, uniform in [-1, 1]^2."""

    @float32
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
