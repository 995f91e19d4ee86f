"""The interface of simulators outside jit."""

from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.errors import UserError
from vertiwm_jax.learning.dataset import Array, WheelSignals
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap

SETTLE_SECONDS = 1.5
"""Time for which a vehicle stands still before it starts, s."""
_TYRE = 0.2
"""Half of the length, m, over which the ground under a tire is taken as a plane."""


class SimulatorError(UserError):
    """A simulator cannot be run; the message says what it needs."""


@struct.dataclass
class Observation:
    """The observed state of one vehicle, in NumPy arrays.

    state: `[12]` as `VehicleState.vector`, of the body origin between the wheel centers.
    wheel_class: `[4]` uint8, ground class under each wheel.
    wheels: state of the wheels, where known; forces are means over the last step.
    """

    state: Array
    wheel_class: Array
    wheels: WheelSignals


class Simulator(Protocol):
    """Drives one vehicle on one world in steps of 0.1 s."""

    def start(self, x: float, y: float, yaw: float) -> Observation:
        """Places a vehicle at rest at x, y, m, with heading yaw, rad."""
        ...

    def step(self, command: np.ndarray) -> Observation:
        """Drives for 0.1 s. command: `[2]` speed, m/s, and front-wheel angle, rad."""
        ...


def under_wheels(
    terrain: TerrainMap, center: jax.Array, radius: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Ground class `[4]` uint8 under wheels, and how deep they reach below the map `[4]`, m.

    center: `[4, 3]` of the wheels, world frame, m; radius: `[]` m. The depth is along the normal
    of the undeformed ground, as in the recorded drives; negative in the air.
    """
    around = _TYRE * jnp.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], jnp.float32)
    ground = query.surface(terrain, center[:, None, :2] + around)
    middle, east, west, north, south = jnp.moveaxis(ground.height, -1, 0)
    slope_x, slope_y = (east - west) / (2 * _TYRE), (north - south) / (2 * _TYRE)
    depth = radius - (center[:, 2] - middle) / jnp.sqrt(1 + slope_x**2 + slope_y**2)
    return ground.semantic[:, 0].astype(jnp.uint8), depth
