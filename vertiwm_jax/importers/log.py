"""A logged drive, checked and converted to SI units, full size and the axes of this project."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vertiwm_jax.importers import commands
from vertiwm_jax.importers.settings import ImportSettings
from vertiwm_jax.learning.schema import DataError

_Some = slice | np.ndarray
_OF_POSES = "position", "attitude", "velocity", "angular_velocity"


@dataclass(frozen=True)
class Log:
    """N poses of the logged point and M commands, each with its own time stamps.

    A reader gives them in the units and frames of its file, `converted` in those that follow.

    time: `[N]` s, increasing; position: `[N, 3]` p_world, m; attitude: of body to world, `[N, 3]`
    roll, pitch, yaw, rad, or `[N, 4]` quaternions x, y, z, w; command_time: `[M]` s, increasing;
    command: `[M, 2]` speed and front-wheel angle, m/s and rad, or of a skid-steered vehicle the yaw
    rate, rad/s; kind: what a reader gives instead; velocity: `[N, 3]` v_body, m/s, and
    angular_velocity: `[N, 3]` omega_body, rad/s, None where they were not logged; name: of the
    file, and of the drive in it; remarks: what was found and left out of the file, and how many
    samples.
    """

    time: np.ndarray
    position: np.ndarray
    attitude: np.ndarray
    command_time: np.ndarray
    command: np.ndarray
    velocity: np.ndarray | None = None
    angular_velocity: np.ndarray | None = None
    kind: commands.Kind = "steering"
    name: str = ""
    remarks: dict[str, int] = field(default_factory=dict)

    @cached_property
    def rotation(self) -> Rotation:
        """N attitudes."""
        if self.attitude.shape[1] == 4:
            return Rotation.from_quat(self.attitude)
        return Rotation.from_euler("ZYX", self.attitude[:, ::-1])

    def part(self, poses: _Some, commands: _Some = slice(None)) -> "Log":
        """The log with some of its poses and commands."""
        chosen = dict.fromkeys(("time", *_OF_POSES), poses)
        chosen |= dict.fromkeys(("command_time", "command"), commands)
        logged = {k: (getattr(self, k), some) for k, some in chosen.items()}
        return replace(self, **{k: x if x is None else x[some] for k, (x, some) in logged.items()})


def converted(
    log: Log,
    name: str | Path,
    settings: ImportSettings,
    remarks: Iterable[tuple[str, int]] = (),
) -> list[Log]:
    """The log in SI units, at full size and in the axes of this project.

    Samples that cannot be used are left out: those that are not finite, quaternions whose length is
    not 1, and stamps that do not follow those before. The log is cut where its clock is set back.

    log: in the units and frames of its file, called `name`; remarks: what its reader left out.

    Returns:
        A log for each time that the clock was set back, and one more. Remarks of the first say what
        was left out.

    Raises:
        DataError: there are no poses or commands, or more than half of them cannot be used.
    """
    said = dict(remarks)
    gap = settings.resampling.gap / settings.units.time / settings.vehicle.scale**0.5
    poses = _usable(name, log, ("time", *_OF_POSES), gap, said)
    commands = _usable(name, log, ("command_time", "command"), gap, said)
    if len(poses) != len(commands):
        raise DataError(
            f"{name}: time: expected clocks of poses and commands that are set back together, "
            f"found {len(poses) - 1} and {len(commands) - 1} times"
        )
    logs = [_in_si(log.part(*both), settings) for both in zip(poses, commands, strict=True)]
    logs = [replace(log, name=str(name)) for log in logs]
    return [replace(logs[0], remarks=said), *logs[1:]]


def _in_si(log: Log, settings: ImportSettings) -> Log:
    units, frames = settings.units, settings.frames
    meter = settings.vehicle.scale
    second = meter**0.5  # Froude's similarity: gravity is the same at any size.
    # Half a turn about x takes z_down to z_up, in the world and in the body.
    axes = np.array([1, 1, 1] if frames.axes == "z_up" else [1, -1, -1])
    if log.attitude.shape[1] == 3:
        attitude = axes * units.angle * log.attitude
    else:
        attitude = log.attitude * [*axes, 1]
    rotation = replace(log, attitude=attitude).rotation

    def in_body(logged: np.ndarray | None, unit: float, frame: str) -> np.ndarray | None:
        if logged is None:
            return None
        turned = axes * unit * logged
        return turned if frame == "body" else rotation.inv().apply(turned)

    turn = units.speed if log.kind == "wheels" else units.steering
    commanded = commands.of_vehicle(log.command * [units.speed, turn], log.kind, settings.vehicle)
    return Log(
        time=second * units.time * log.time,
        position=meter * (axes * units.position * log.position - np.asarray(frames.origin)),
        attitude=attitude,
        command_time=second * (units.time * log.command_time + settings.resampling.delay),
        command=commanded
        * [meter / second, 1 if settings.vehicle.turn == "steering" else 1 / second],
        velocity=in_body(log.velocity, units.velocity * meter / second, frames.velocity),
        angular_velocity=in_body(
            log.angular_velocity, units.angle / second, frames.angular_velocity
        ),
    )


def _usable(
    name: str | Path, log: Log, fields: Sequence[str], gap: float, said: dict[str, int]
) -> list[np.ndarray]:
    """Indices of the samples that can be used, apart wherever their clock was set back.

    fields: of the samples, stamps first; gap: by which a clock is set back, in units of the stamps,
    where a single stamp that falls back is only wrong; said: what is said of others.
    """
    stamps = getattr(log, fields[0])
    usable = np.ones(len(stamps), bool)

    def called(field: str) -> str:
        return f"{name}: {'time of commands' if field == 'command_time' else field}:"

    def leave_out(expected: str, wrong: np.ndarray, values: np.ndarray) -> None:
        samples = np.flatnonzero(wrong & usable)
        if not len(samples):
            return
        usable[samples] = False
        first, last = samples[0], len(stamps) - 1
        found = f"{expected}, found {values[first]} in sample {first} among {len(samples)} such"
        if 2 * len(samples) > len(stamps):
            raise DataError(found)
        before, after = stamps[max(first - 1, 0)], stamps[min(first + 1, last)]
        said[f"{found}, between {before:.13g} and {after:.13g}: left out"] = len(samples)

    for quantity in fields:
        values = getattr(log, quantity)
        if values is None:
            continue
        if not len(values):
            raise DataError(f"{called(quantity)} expected one value or more, found none")
        fine = np.isfinite(values.reshape(len(values), -1)).all(1)
        leave_out(f"{called(quantity)} expected finite numbers", ~fine, values)
        if quantity == "attitude" and values.shape[1] == 4:
            length = np.linalg.norm(values, axis=1)
            wrong = np.abs(length - 1) > 0.01
            leave_out(f"{called(quantity)} expected quaternions of length 1", wrong, length)
    number = np.flatnonzero(usable)
    time = stamps[number]
    fallen = np.flatnonzero(np.diff(time) < -gap) + 1
    back = [i for i in fallen if i + 1 < len(time) and time[i + 1] <= time[i - 1]]
    for i in back:
        said[f"{called(fields[0])} is set back from {time[i - 1]:.13g} to {time[i]:.13g}"] = 0
    parts = np.split(number, back)
    late = np.zeros(len(stamps), bool)
    for part in parts:
        late[part[1:]] = stamps[part[1:]] <= np.maximum.accumulate(stamps[part[:-1]])
    leave_out(f"{called(fields[0])} expected stamps that increase", late, stamps)
    return [part[usable[part]] for part in parts]
