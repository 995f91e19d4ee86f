"""Drives in a simulator, and the files that keep them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from vertiwm_jax.learning import schema
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.simulators.excitation import MARGIN, Pilot, within
from vertiwm_jax.simulators.protocol import Observation, Simulator
from vertiwm_jax.terrain.map import TerrainMap

LEAST_UPRIGHT = 0.3
"""Cosine of the tilt below which a vehicle has rolled over."""
LARGEST_SPEED = 30.0
"""m/s, beyond which a simulation has diverged."""

Ending = Literal["time", "left the map", "rolled over", "diverged"]


@dataclass(frozen=True)
class Drive:
    """One drive of T steps.

    observations: T + 1; control: `[T, 2]` commanded speed, m/s, and front-wheel angle, rad.
    """

    observations: list[Observation]
    control: np.ndarray
    ending: Ending


def record(
    simulator: Simulator,
    terrain: TerrainMap,
    start: Sequence[float],
    pilot: Pilot,
    steps: int,
) -> Drive:
    """Drives until `steps` are done, or the vehicle leaves the map or rolls over.

    terrain: what the simulator drives on. A state that diverged is left out.
    """
    low, high = within(terrain, MARGIN)
    observations, control = [simulator.start(*start)], []
    state = np.asarray(observations[0].state)
    ending = _ending(state, low, high)
    while ending is None and len(control) < steps:
        command = pilot(state)
        seen = simulator.step(command)
        state = np.asarray(seen.state)
        ending = _ending(state, low, high)
        if ending != "diverged":
            control.append(command)
            observations.append(seen)
    return Drive(observations, np.reshape(control, (-1, 2)), ending or "time")


def write(
    path: Path, drives: Sequence[Drive], steps: int, meta: dict[str, Any], vehicle: Vehicle
) -> None:
    """A file of the schema with K drives of a vehicle, each filled up to `steps`.

    meta: holds "map", the file name of the terrain map.
    """
    arrays = schema.join([_arrays(drive) for drive in drives], steps)
    arrays["ending"] = np.array([drive.ending for drive in drives])
    schema.write(path, arrays, meta, vehicle.wheel_position)


def _arrays(drive: Drive) -> dict[str, np.ndarray]:
    """Arrays of the schema `[T + 1, ...]`, of the control `[T, 2]`."""
    seen = jax.tree.map(lambda *x: np.stack(x), *drive.observations)
    arrays = {"state": seen.state, "control": drive.control, "wheel_class": seen.wheel_class}
    known = {name: getattr(seen.auxiliary, name) for name in schema.AUXILIARY}
    return arrays | {name: array for name, array in known.items() if array is not None}


def _ending(state: np.ndarray, low: np.ndarray, high: np.ndarray) -> Ending | None:
    """Why a drive cannot go on, if it cannot; low, high: `[2]` m, where it may be."""
    if not np.isfinite(state).all() or np.linalg.norm(state[6:9]) > LARGEST_SPEED:
        return "diverged"
    if ((state[:2] < low) | (state[:2] > high)).any():
        return "left the map"
    if np.cos(state[3]) * np.cos(state[4]) < LEAST_UPRIGHT:
        return "rolled over"
    return None
