"""A logged drive, checked and converted to SI units, full size and the axes of this project."""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vertiwm_jax.importers.settings import ImportSettings
from vertiwm_jax.learning.schema import DataError


@dataclass(frozen=True)
class Log:
    """N poses of the logged point and M commands, each with its own time stamps.

    time: `[N]` s, increasing; position: `[N, 3]` p_world, m; rotation: N of body to world;
    velocity: `[N, 3]` v_body, m/s, angular_velocity: `[N, 3]` omega_body, rad/s, None where they
    were not logged; command_time: `[M]` s, increasing; command: `[M, 2]` m/s and rad.
    """

    time: np.ndarray
    position: np.ndarray
    rotation: Rotation
    velocity: np.ndarray | None
    angular_velocity: np.ndarray | None
    command_time: np.ndarray
    command: np.ndarray


def build(
    name: str | Path,
    settings: ImportSettings,
    time: np.ndarray,
    position: np.ndarray,
    attitude: np.ndarray,
    command_time: np.ndarray,
    command: np.ndarray,
    velocity: np.ndarray | None = None,
    angular_velocity: np.ndarray | None = None,
) -> Log:
    """Makes a log from arrays in the units and frames of the log file.

    time: `[N]`; position: `[N, 3]`; attitude: `[N, 3]` roll, pitch, yaw or `[N, 4]` quaternions
    x, y, z, w; velocity, angular_velocity: `[N, 3]`; command_time: `[M]`; command: `[M, 2]` speed
    and steering. Raises `DataError`, which calls the log `name`, unless all are finite, stamps
    increase, quaternions have length 1 and there are two poses.
    """
    arrays = {
        "time": time,
        "position": position,
        "attitude": attitude,
        "velocity": velocity,
        "angular_velocity": angular_velocity,
        "time of commands": command_time,
        "command": command,
    }
    for field, array in arrays.items():
        if array is not None:
            _check_finite(f"{name}: {field}", array)
    if len(time) < 2:
        raise DataError(f"{name}: time: expected two poses or more, found one")
    for field, stamps in (("time", time), ("time of commands", command_time)):
        wrong = np.diff(stamps, prepend=-np.inf) <= 0
        _refuse(f"{name}: {field}: expected stamps that increase", wrong, stamps)
    units, frames = settings.units, settings.frames
    meter = settings.vehicle.scale
    second = meter**0.5  # Froude's similarity: gravity is the same at any size.
    # Half a turn about x takes z_down to z_up, in the world and in the body.
    axes = np.array([1, 1, 1] if frames.axes == "z_up" else [1, -1, -1])
    if attitude.shape[1] == 3:
        rpy = axes * units.angle * attitude
        rotation = Rotation.from_euler("ZYX", rpy[:, ::-1])
    else:
        length = np.linalg.norm(attitude, axis=1)
        wrong = np.abs(length - 1) > 0.01
        _refuse(f"{name}: attitude: expected quaternions of length 1", wrong, length)
        rotation = Rotation.from_quat(attitude * [*axes, 1])
    if velocity is not None:
        velocity = axes * units.velocity * meter / second * velocity
        velocity = velocity if frames.velocity == "body" else rotation.inv().apply(velocity)
    if angular_velocity is not None:
        omega = axes * units.angle / second * angular_velocity
        angular_velocity = (
            omega if frames.angular_velocity == "body" else rotation.inv().apply(omega)
        )
    return Log(
        time=second * units.time * time,
        position=meter * (axes * units.position * position - np.asarray(frames.origin)),
        rotation=rotation,
        velocity=velocity,
        angular_velocity=angular_velocity,
        command_time=second * units.time * command_time,
        command=command * [meter / second * units.speed, units.steering],
    )


def needed(path: Path, module: str) -> Any:
    """A module that reading `path` needs; `DataError` where its package is not installed."""
    try:
        return import_module(module)
    except ImportError:
        raise DataError(
            f"{path}: expected the package {module.split('.')[0]} to read it, it is not installed; "
            "pip install 'vertiwm-jax[logs]'"
        ) from None


def _check_finite(field: str, array: np.ndarray) -> None:
    if not len(array):
        raise DataError(f"{field}: expected one value or more, found none")
    wrong = ~np.isfinite(array.reshape(len(array), -1)).all(1)
    _refuse(f"{field}: expected finite numbers", wrong, array)


def _refuse(expected: str, wrong: np.ndarray, values: np.ndarray) -> None:
    """Raises `DataError` where samples are wrong: `[N]` whether each is, of `[N, ...]` values."""
    samples = np.flatnonzero(wrong)
    if len(samples):
        first = samples[0]
        raise DataError(
            f"{expected}, found {values[first]} in sample {first} among {len(samples)} such"
        )
