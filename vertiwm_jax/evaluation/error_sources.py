"""Where the prediction error comes from, and the predicted wheels beside the recorded ones."""

import itertools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.evaluation.tables import Row
from vertiwm_jax.learning.dataset import WheelSignals

SPEEDS = (0.5, 1.5, 2.5, 3.5)  # m/s
TILTS = (5.0, 10.0, 20.0)  # deg
DISTANCES = (1.0, 2.0, 4.0, 8.0)  # m
_DIRECTIONS = 16
_QUANTITIES: Mapping[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    # Recorded sinkage of a wheel in the air is negative, predicted sinkage is 0.
    "sinkage, mm": ("wheel_sinkage", lambda depth: 1000 * np.maximum(depth, 0.0)),
    "speed, rad/s": ("wheel_omega", lambda speed: speed),
    "force, kN": ("wheel_force", lambda force: np.linalg.norm(force, axis=-1) / 1000),
}
"""What is compared of wheels: the signal, and how it is told."""


def shares(test: TestWindows, error: np.ndarray) -> list[Row]:
    """Groups windows by what was recorded in the predicted steps.

    Args:
        test: N windows.
        error: `[N]` m, position errors after the last step.

    Returns:
        A row for each group, by speed, slope, ground, border and belly contact: its share of all
        windows, %, its mean error, m, and its share of the sum of all errors, %.
    """
    c, state = test.windows.context, np.asarray(test.windows.state)
    tilt = np.degrees(np.abs(state[:, c:, 3:5]).max(axis=2).mean(axis=1))
    kind, distance = _ground(test)
    groups = {
        "speed at the start, m/s": _binned(np.linalg.norm(state[:, c, 6:9], axis=1), SPEEDS),
        "roll or pitch, deg": _binned(tilt, TILTS),
        "ground under the vehicle": (test.terrain.class_names, kind),
        "border of soil, m away": _binned(distance, DISTANCES),
    }
    force = test.windows.wheels.chassis_force
    if force is not None:
        touches = np.linalg.norm(force[:, c + 1 :], axis=-1).max(axis=1) > 0
        groups["belly"] = ("free", "on the ground"), touches.astype(int)
    rows = []
    for quantity, (names, group) in groups.items():
        for i in np.unique(group):
            inside = group == i
            rows.append(
                {
                    "quantity": quantity,
                    "value": names[i],
                    "windows, %": 100 * float(inside.mean()),
                    "mean error, m": float(error[inside].mean()),
                    "error, %": 100 * float(error[inside].sum() / max(error.sum(), 1e-12)),
                }
            )
    return rows


def _binned(values: np.ndarray, edges: Sequence[float]) -> tuple[list[str], np.ndarray]:
    """Names of all bins, and `[N]` the bin of each value."""
    between = [f"{low:g} to {high:g}" for low, high in itertools.pairwise(edges)]
    names = [f"below {edges[0]:g}", *between, f"{edges[-1]:g} and more"]
    return names, np.digitize(values, edges)


def _ground(test: TestWindows) -> tuple[np.ndarray, np.ndarray]:
    """`[N]` class below the vehicle at the start, and distance m to where it is soil or not."""
    start = np.asarray(test.windows.state)[:, test.windows.context, :2]
    angle = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings = start[:, None, None] + np.array(DISTANCES)[:, None, None] * ring
    kind, around = test.classes(start), test.classes(rings)
    soft = np.asarray(test.terrain.deformable)
    differs = (soft[around] != soft[kind][:, None, None]).any(axis=-1)
    beyond = np.where(differs.any(axis=1), differs.argmax(axis=1), len(DISTANCES))
    # A ring that meets other ground puts the border within it and outside the one before.
    return kind, np.append(DISTANCES, np.inf)[beyond] - 1e-6


def wheels(predicted: WheelSignals | None, test: TestWindows) -> list[Row]:
    """Compares sinkage in soil, speed and force of all wheels after the last step.

    Args:
        predicted: leaves `[N, K, 4, ...]`; None of a model without wheels.
        test: the N windows.

    Returns:
        A row for each quantity and kind of ground: the recorded mean, the mean absolute error, both
        in the unit of the quantity, and the correlation. Quantities that are not modeled or not
        recorded have no rows.
    """
    rows = []
    for name, (signal, told) in _QUANTITIES.items():
        both = [getattr(known, signal, None) for known in (test.windows.wheels, predicted)]
        if any(values is None for values in both):
            continue
        for kind, on in test.of_ground.items():
            # On rigid ground, and on the rigid side of a border, no wheel sinks.
            if kind != "deformable" and signal == "wheel_sinkage":
                continue
            x, y = (told(np.asarray(values)[on, -1]).ravel() for values in both)
            with np.errstate(invalid="ignore"):  # A constant correlates with nothing.
                correlation = float(np.corrcoef(x, y)[0, 1])
            rows.append(
                {
                    "wheels": name,
                    "ground": kind,
                    "recorded mean": float(x.mean()),
                    "mean error": float(np.abs(y - x).mean()),
                    "correlation": correlation,
                }
            )
    return rows
