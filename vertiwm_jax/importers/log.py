"""A logged drive, checked and converted to SI units, full size and the axes of this project."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vertiwm_jax.importers.settings import ImportSettings
from vertiwm_jax.learning.schema import DataError


@dataclass(frozen=True)
class Log:
    """N poses of the logged point and M commands, each with its own time stamps.

    A reader gives them in the units and frames of its file, `converted` in those that follow.

    time: `[N]` s, increasing; position: `[N, 3]` p_world, m; attitude: of body to world, `[N, 3]`
    roll, pitch, yaw, rad, or `[N, 4]` quaternions x, y, z, w; command_time: `[M]` s, increasing;
    command: `[M, 2]` speed and front-wheel angle, m/s and rad; velocity: `[N, 3]` v_body, m/s, and
    angular_velocity: `[N, 3]` omega_body, rad/s, None where they were not logged.
    """

    time: np.ndarray
    position: np.ndarray
    attitude: np.ndarray
    command_time: np.ndarray
    command: np.ndarray
    velocity: np.ndarray | None = None
    angular_velocity: np.ndarray | None = None

    @cached_property
    def rotation(self) -> Rotation:
        """N attitudes."""
        if self.attitude.shape[1] == 4:
            return Rotation.from_quat(self.attitude)
        return Rotation.from_euler("ZYX", self.attitude[:, ::-1])

    def part(self, poses: slice) -> "Log":
        """The log with some of its poses, and all commands."""
        names = ("time", "position", "attitude", "velocity", "angular_velocity")
        logged = {name: getattr(self, name) for name in names}
        return replace(self, **{k: x if x is None else x[poses] for k, x in logged.items()})


def converted(log: Log, name: str | Path, settings: ImportSettings) -> Log:
    """The log in SI units, at full size and in the axes of this project.

    log: in the units and frames of its file. Raises `DataError`, which calls it `name`, unless all
    are finite, stamps increase, quaternions have length 1 and there are two poses.
    """
    for field, array in vars(log).items():
        if array is None:
            continue
        called = f"{name}: {'time of commands' if field == 'command_time' else field}"
        if not len(array):
            raise DataError(f"{called}: expected one value or more, found none")
        wrong = ~np.isfinite(array.reshape(len(array), -1)).all(1)
        _refuse(f"{called}: expected finite numbers", wrong, array)
        if array.ndim == 1:
            wrong = np.diff(array, prepend=-np.inf) <= 0
            _refuse(f"{called}: expected stamps that increase", wrong, array)
    if len(log.time) < 2:
        raise DataError(f"{name}: time: expected two poses or more, found one")
    units, frames = settings.units, settings.frames
    meter = settings.vehicle.scale
    second = meter**0.5  # Froude's similarity: gravity is the same at any size.
    # Half a turn about x takes z_down to z_up, in the world and in the body.
    axes = np.array([1, 1, 1] if frames.axes == "z_up" else [1, -1, -1])
    if log.attitude.shape[1] == 3:
        attitude = axes * units.angle * log.attitude
    else:
        length = np.linalg.norm(log.attitude, axis=1)
        wrong = np.abs(length - 1) > 0.01
        _refuse(f"{name}: attitude: expected quaternions of length 1", wrong, length)
        attitude = log.attitude * [*axes, 1]
    rotation = replace(log, attitude=attitude).rotation

    def in_body(logged: np.ndarray | None, unit: float, frame: str) -> np.ndarray | None:
        if logged is None:
            return None
        turned = axes * unit * logged
        return turned if frame == "body" else rotation.inv().apply(turned)

    return Log(
        time=second * units.time * log.time,
        position=meter * (axes * units.position * log.position - np.asarray(frames.origin)),
        attitude=attitude,
        command_time=second * units.time * log.command_time,
        command=log.command * [meter / second * units.speed, units.steering],
        velocity=in_body(log.velocity, units.velocity * meter / second, frames.velocity),
        angular_velocity=in_body(
            log.angular_velocity, units.angle / second, frames.angular_velocity
        ),
    )


def _refuse(expected: str, wrong: np.ndarray, values: np.ndarray) -> None:
    """Raises `DataError` where samples are wrong: `[N]` whether each is, of `[N, ...]` values."""
    samples = np.flatnonzero(wrong)
    if len(samples):
        first = samples[0]
        raise DataError(
            f"{expected}, found {values[first]} in sample {first} among {len(samples)} such"
        )
