"""The interface of simulators outside jit, and the loop that drives a vehicle in one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

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


Ending = Literal["time", "left the map", "rolled over", "diverged"]

Pilot = Callable[[np.ndarray], np.ndarray | None]
"""State `[12]` to the command `[2]` of the next step: speed, m/s, and front-wheel angle, rad.

None ends the drive.
"""


@dataclass(frozen=True)
class Drive:
    """One drive of T steps.

    observations: T + 1; control: `[T, 2]` commanded speed, m/s, and front-wheel angle, rad.
    """

    observations: list[Observation]
    control: np.ndarray
    ending: Ending


def drive(
    simulator: Simulator,
    start: Sequence[float],
    pilot: Pilot,
    steps: int,
    over: Callable[[np.ndarray], Ending | None] = lambda state: None,
) -> Drive:
    """Drives until `steps` are done, the pilot gives no command, or it is over.

    Args:
        simulator: what moves the vehicle.
        start: x, y, m, and yaw, rad.
        pilot: what commands it.
        steps: of 0.1 s, at most.
        over: tells of a state `[12]` why the drive cannot go on, if it cannot.

    Returns:
        The drive; a state that diverged is left out.
    """
    observations, control = [simulator.start(*start)], []
    state = np.asarray(observations[0].state)
    ending = over(state)
    while ending is None and len(control) < steps:
        command = pilot(state)
        if command is None:
            break
        seen = simulator.step(command)
        state = np.asarray(seen.state)
        ending = over(state)
        if ending != "diverged":
            control.append(command)
            observations.append(seen)
    return Drive(observations, np.reshape(control, (-1, 2)), ending or "time")


def under_wheels(
    terrain: TerrainMap, center: jax.Array, radius: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Ground class `[4]` uint8 under wheels, and how deep they reach below the map `[4]`, m.

    center: `[4, 3]` of the wheels, world frame, m; radius: `[]` or `[4]` m. The depth is along the
    normal of the undeformed ground, as in the recorded drives; negative in the air.
    """
    around = _TYRE * jnp.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], jnp.float32)
    ground = query.surface(terrain, center[:, None, :2] + around)
    middle, east, west, north, south = jnp.moveaxis(ground.height, -1, 0)
    slope_x, slope_y = (east - west) / (2 * _TYRE), (north - south) / (2 * _TYRE)
    depth = radius - (center[:, 2] - middle) / jnp.sqrt(1 + slope_x**2 + slope_y**2)
    return ground.semantic[:, 0].astype(jnp.uint8), depth
