"""Resamples logs with irregular time stamps to drives at 10 Hz."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from vertiwm_jax.importers.log import Log
from vertiwm_jax.importers.settings import Resampling
from vertiwm_jax.state import STEP_SECONDS

_TOLERANCE = 1e-6
"""s; stamps since 1970 are no finer in double precision than 2.4e-7 s."""
_FASTEST, _NEAR = 50.0, 1.0
"""m/s and m; positions that are farther apart than either allows leap."""
_HALF_BASE = 2
"""Steps before and after a moment between which the way is measured that its velocity points."""
_ROUGH, _WIDEST = 0.05, 1.5
"""m/s that noise of positions may add to a velocity, and s that a window becomes for it at most."""
_EACH_SIDE = 3
"""Poses before and after a moment that a parabola is fitted to, however few its window holds."""


LeftOut = defaultdict[str, list[float]]
"""When something was left out or cut, s, by the reason."""


@dataclass(frozen=True)
class Drive:
    """T steps: state `[T + 1, 12]` and control `[T, 2]`, as in the schema of recorded drives.

    start: s, the log's time of the first state.
    """

    start: float
    state: np.ndarray
    control: np.ndarray


def resample(
    log: Log, settings: Resampling, logged_point: np.ndarray
) -> tuple[list[Drive], LeftOut]:
    """The drives between the gaps and leaps of a log, and what is left out or cut.

    logged_point: `[3]` m in the body frame, the point whose position was logged. Positions and
    logged velocities are interpolated linearly, attitudes along the shortest rotation; a command
    holds until the next. Velocities that were not logged are slopes of parabolas that are fitted to
    the poses within `settings.window`.
    """
    drives, left_out = list[Drive](), LeftOut(list)
    moved = np.linalg.norm(np.diff(log.position, axis=0), axis=1)
    leaps = moved > _NEAR + _FASTEST * np.diff(log.time)
    if leaps.any():
        left_out["cut at a leap of the position"] += log.time[1:][leaps].tolist()
    commanded = [
        (log.command_time[run][0], log.command_time[run][-1] + settings.command_gap)
        for run in _runs(log.command_time, settings.command_gap)
    ]
    for poses in _runs(log.time, settings.gap, leaps):
        part = log.part(poses)
        last = part.time[-1]
        for first, until in commanded:
            start, end = max(part.time[0], first), min(last, until)
            if end < start:
                continue
            steps = int((end - start + _TOLERANCE) / STEP_SECONDS)
            if steps < settings.shortest:
                left_out[f"shorter than {settings.shortest} steps"].append(start)
                continue
            at = np.minimum(start + STEP_SECONDS * np.arange(steps + 1), last)
            state = _state(part, at, settings.window, logged_point)
            latest = np.searchsorted(log.command_time, at[:-1] + _TOLERANCE, side="right") - 1
            drives += _pieces(Drive(start, state, log.command[latest]), settings.longest)
    return drives, left_out


def directions(drives: Sequence[Drive]) -> tuple[float, float]:
    """Median angles, rad, over the steps at 1 m/s or more; NaN if there are none.

    The first is between the velocity and the way from shortly before to shortly after, the second
    between the velocity and the body's x axis.
    """
    before, after = slice(None, -2 * _HALF_BASE), slice(2 * _HALF_BASE, None)
    state = np.concatenate([drive.state[_HALF_BASE:-_HALF_BASE] for drive in drives])
    moved = np.concatenate([drive.state[after, :3] - drive.state[before, :3] for drive in drives])
    moving = (np.linalg.norm(state[:, 6:9], axis=1) > 1) & moved.any(axis=1)
    if not moving.any():
        return np.nan, np.nan
    velocity, attitude = state[moving, 6:9], Rotation.from_euler("ZYX", state[moving, 5:2:-1])
    ahead = np.abs(velocity[:, 0]) / np.linalg.norm(velocity, axis=1)
    way = attitude.inv().apply(moved[moving])
    along = (way * velocity).sum(1) / np.linalg.norm(way, axis=1) / np.linalg.norm(velocity, axis=1)
    way_off, axis_off = (np.median(np.arccos(np.clip(c, -1, 1))) for c in (along, ahead))
    return float(way_off), float(axis_off)


def _runs(stamps: np.ndarray, gap: float, cut: np.ndarray | bool = False) -> Iterator[slice]:
    """Where `[N]` stamps follow each other within `gap`, without a cut: `[N - 1]`."""
    cuts = np.flatnonzero((np.diff(stamps) > gap) | cut) + 1
    for first, end in pairwise([0, *cuts, len(stamps)]):
        yield slice(first, end)


def _state(log: Log, at: np.ndarray, window: float, logged_point: np.ndarray) -> np.ndarray:
    """`[T + 1, 12]` states at `[T + 1]` moments, from poses without a gap."""
    attitude = Slerp(log.time, log.rotation)(at)

    def between(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(at, log.time, column) for column in values.T], 1)

    velocity = None if log.velocity is None else between(log.velocity)
    omega = None if log.angular_velocity is None else between(log.angular_velocity)
    if velocity is None or omega is None:
        fitted = _slopes(log, at, attitude, max(window, _quiet(log)))
        velocity = attitude.inv().apply(fitted[:, :3]) if velocity is None else velocity
        omega = fitted[:, 3:] if omega is None else omega
    return np.concatenate(
        [
            between(log.position) - attitude.apply(logged_point),
            attitude.as_euler("ZYX")[:, ::-1],
            velocity - np.cross(omega, logged_point),
            omega,
        ],
        axis=1,
    )


def _quiet(log: Log) -> float:
    """s over which a parabola has to be fitted for slopes that noise makes no rougher than allowed.

    Noise shows in how far a position is from the line between its neighbors.
    """
    time, position = log.time, log.position
    if len(time) < 3:
        return 0.0
    apart = time[2:] - time[:-2]
    share = ((time[1:-1] - time[:-2]) / apart)[:, None]
    off = position[1:-1] - (1 - share) * position[:-2] - share * position[2:]
    noise = np.median(np.abs(off) / (0.6745 * np.sqrt(1 + share**2 + (1 - share) ** 2)))
    return float(min((6 * np.median(apart) * (noise / _ROUGH) ** 2) ** (1 / 3), _WIDEST))


def _slopes(log: Log, at: np.ndarray, attitude: Rotation, window: float) -> np.ndarray:
    """`[T + 1, 6]` v_world, m/s, and omega_body, rad/s, at moments and attitudes there.

    As Savitzky and Golay smooth, but over the stamps as they are: at the ends of a drive the
    window is moved inwards. Rotations are fitted as rotation vectors from the attitude there.
    """
    time, slopes = log.time, np.empty((len(at), 6))
    inside = np.clip(at, time[0] + window / 2, max(time[-1], time[0] + window) - window / 2)
    first, middle, end = (np.searchsorted(time, inside + d) for d in (-window / 2, 0, window / 2))
    first = np.minimum(first, np.maximum(middle - _EACH_SIDE, 0))
    end = np.maximum(end, np.minimum(middle + _EACH_SIDE, len(time)))
    for k, moment in enumerate(at):
        near = slice(first[k], end[k])
        turned = (attitude[k].inv() * log.rotation[near]).as_rotvec()
        values = np.concatenate([log.position[near], turned], axis=1)
        slopes[k] = np.polynomial.polynomial.polyfit(time[near] - moment, values, 2)[1]
    return slopes


def _pieces(drive: Drive, longest: int) -> Iterator[Drive]:
    """The drive in equal pieces, each of which begins in the state that the last one ended in."""
    steps = len(drive.control)
    cuts = np.linspace(0, steps, -(-steps // longest) + 1).astype(int)
    for first, end in pairwise(cuts):
        start = drive.start + STEP_SECONDS * first
        yield Drive(start, drive.state[first : end + 1], drive.control[first:end])
