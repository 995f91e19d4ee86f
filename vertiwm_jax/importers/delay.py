"""How late a vehicle acts on its commands: one estimate of a delay, beside its own lags."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from vertiwm_jax.state import Turn

_GRID = 0.01
_DELAYS = np.arange(0, 0.805, _GRID)
_LAGS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8, 1.2)
_EXPLAINED = 0.15
"""Share of a motion that commands have to explain, or they tell nothing of when they act."""
_BEFORE = 5.0  # s in which a lag forgets
_APART = 5  # samples that tell as much as one, as velocities are smooth
_DROP = 1.35  # of the logarithm of the likelihood, at the ends of a 90 % interval
_VAGUE = 0.25  # s
_MOST = 20_000


@dataclass(frozen=True)
class Response:
    """A drive without gaps, and all commands of its log.

    time: `[T]` s; speed, yaw_rate: `[T]` m/s and rad/s; command_time: `[M]` s; command: `[M, 2]`
    speed and turn, m/s and rad or rad/s, each held until the next; turn: what turns, a front-wheel
    angle or the yaw rate of a skid-steered vehicle.
    """

    time: np.ndarray
    speed: np.ndarray
    yaw_rate: np.ndarray
    command_time: np.ndarray
    command: np.ndarray
    turn: Turn = "steering"


@dataclass(frozen=True)
class Delay:
    """seconds: after which commands act, and the 90 % interval; lags: s, with which speed and yaw
    rate then follow, None of what the commands do not explain."""

    seconds: float
    low: float
    high: float
    lags: tuple[float | None, float | None]


def estimate(responses: Sequence[Response], window: float = 0.0) -> Delay | None:
    """The delay with which first-order lags explain speeds and yaw rates best.

    The speed follows the commanded one, the yaw rate the speed times the tangent of the angle, or
    the commanded yaw rate, each with a gain, an offset and a lag of its own; the delay is of both.
    What neither explains, or would at most delays, has none: None.

    responses: of one vehicle; window: s over which parabolas were fitted to positions, where speeds
    and yaw rates are their slopes.
    """
    motions = {
        "speed": np.concatenate([each.speed for each in responses]),
        "yaw_rate": np.concatenate([each.yaw_rate for each in responses]),
    }
    every = slice(None, None, 1 + len(motions["speed"]) // _MOST)
    along = motions["speed"][every]
    samples = len(along) / _APART
    loss, lags = np.zeros(len(_DELAYS)), list[np.ndarray | None]()
    for column, motion in enumerate(motions.values()):
        angle = column and responses[0].turn == "steering"
        weight = along if angle else np.ones(len(along))
        unexplained = np.array(
            [
                _unexplained(responses, column, lag, window, motion[every], weight, every)
                for lag in _LAGS
            ]
        )
        if unexplained.min() > 1 - _EXPLAINED:
            lags.append(None)
            continue
        loss += 0.5 * samples * np.log(unexplained.min(axis=0))
        lags.append(np.array(_LAGS)[unexplained.argmin(axis=0)])
    if all(lag is None for lag in lags):
        return None
    best = int(loss.argmin())
    likely = _DELAYS[loss < loss[best] + _DROP]
    if likely[-1] - likely[0] > _VAGUE:
        return None
    speed, yaw_rate = (None if lag is None else float(lag[best]) for lag in lags)
    return Delay(float(_DELAYS[best]), float(likely[0]), float(likely[-1]), (speed, yaw_rate))


def _unexplained(
    responses: Sequence[Response],
    column: int,
    lag: float,
    window: float,
    motion: np.ndarray,
    weight: np.ndarray,
    every: slice,
) -> np.ndarray:
    """`[D]` the share of a motion that a lagged command leaves unexplained, at each delay."""
    followed = np.concatenate([_followed(each, column, lag, window) for each in responses], axis=1)
    model = followed[:, every] * weight
    model = model - model.mean(axis=1, keepdims=True)
    motion = motion - motion.mean()
    norms = np.linalg.norm(model, axis=1) * np.linalg.norm(motion)
    likeness = np.maximum(model @ motion, 0) / np.where(norms > 0, norms, np.inf)
    return np.maximum(1 - likeness**2, 1e-9)


def _followed(response: Response, column: int, lag: float, window: float) -> np.ndarray:
    """`[D, T]` the command as a first-order lag follows it, at each delay."""
    held, command = response.command_time, response.command[:, column]
    command = np.tan(command) if column and response.turn == "steering" else command
    grid = np.arange(response.time[0] - _BEFORE, response.time[-1] + _GRID, _GRID)
    told = command[np.maximum(np.searchsorted(held, grid + 1e-9, side="right") - 1, 0)]
    decay = np.exp(-_GRID / lag) if lag else 0.0
    told, _ = lfilter([1 - decay], [1, -decay], told, zi=[decay * told[0]])
    if window:
        # A parabola's slope is the mean of velocities with these weights.
        side = np.arange(-window / 2, window / 2 + _GRID / 2, _GRID)
        weights = np.maximum(1 - (2 * side / window) ** 2, 0)
        ends = np.pad(told, len(side) // 2, "edge")
        told = np.convolve(ends, weights / weights.sum(), "valid")
    late = response.time - _DELAYS[:, None]
    return np.interp(late, grid[: len(told)], told[: len(grid)])
