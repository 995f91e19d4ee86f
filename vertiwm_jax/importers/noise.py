"""Turns simulated drives into logs as a real vehicle would write them: noisy, late, with gaps."""

from typing import Annotated

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from vertiwm_jax.config import Bounds, NotNegative, Positive, settings
from vertiwm_jax.state import STEP_SECONDS

COLUMNS = (
    "drive", "time", "x", "y", "z", "qx", "qy", "qz", "qw", "speed", "steering",
)  # fmt: skip
"""Of a table of logged drives: s, m, a quaternion, and the command that holds, m/s and rad."""
_TOLERANCE = 1e-9


@settings
class NoiseConfig:
    """Errors of a vehicle's localization, in SI units at the vehicle's own size."""

    rate: Positive = 50.0
    """Poses a second."""
    position: NotNegative = 0.001
    """m, standard deviation along each axis."""
    attitude: NotNegative = 0.005
    """rad, standard deviation about each axis."""
    latency: NotNegative = 0.02
    """s by which the stamp of a pose is late. Stamps of commands are exact."""
    dropped: Annotated[float, Bounds(0, 1, below=True)] = 0.05
    """Share of samples that are lost."""


def logged(
    state: np.ndarray,
    control: np.ndarray,
    scale: float,
    config: NoiseConfig,
    rng: np.random.Generator,
) -> np.ndarray:
    """`[N, 10]` rows of `COLUMNS` but for the drive's number, of one drive of T steps.

    state: `[T + 1, 12]`, control: `[T, 2]`, at full size, that is `scale` times as large as the
    rows. Between its steps a drive is a cubic that has its positions and velocities, and turns
    evenly.
    """
    metre, second = scale, scale**0.5
    known = STEP_SECONDS / second * np.arange(len(state))
    rotation = Rotation.from_euler("ZYX", state[:, 5:2:-1])
    velocity = rotation.apply(state[:, 6:9]) * second / metre
    stamps = np.arange(config.latency, known[-1], 1 / config.rate)
    stamps = stamps[rng.random(len(stamps)) >= config.dropped]
    seen = stamps - config.latency
    position = CubicHermiteSpline(known, state[:, :3] / metre, velocity)(seen)
    turned = Rotation.from_rotvec(config.attitude * rng.normal(size=(len(stamps), 3)))
    step = np.minimum(
        np.searchsorted(known, stamps + _TOLERANCE, side="right") - 1, len(control) - 1
    )
    return np.column_stack(
        [
            stamps,
            position + config.position * rng.normal(size=position.shape),
            (Slerp(known, rotation)(seen) * turned).as_quat(),
            control[step] * [second / metre, 1.0],
        ]
    )
