"""Wheel states of open-loop predictions, beside the recorded ones."""

import operator
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.evaluation.tables import Row
from vertiwm_jax.learning.dataset import Array, WheelSignals
from vertiwm_jax.learning.windows import GROUNDS


def compare(predicted: WheelSignals | None, test: TestWindows) -> list[Row]:
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
    for name, read in _QUANTITIES.items():
        recorded, modeled = read(test.windows.wheels), read(predicted or WheelSignals())
        if recorded is None or modeled is None:
            continue
        for i, kind in enumerate(GROUNDS):
            on = np.asarray(test.windows.ground) == i
            # On rigid ground, and on the rigid side of a border, no wheel sinks.
            if not on.any() or (kind != "deformable" and read is _sinkage):
                continue
            x, y = (np.asarray(values[:, -1])[on].ravel() for values in (recorded, modeled))
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


def _sinkage(wheels: WheelSignals) -> jax.Array | None:
    # Recorded sinkage of a wheel in the air is negative, predicted sinkage is 0.
    depth = wheels.wheel_sinkage
    return None if depth is None else 1000 * jnp.maximum(depth, 0.0)


def _force(wheels: WheelSignals) -> jax.Array | None:
    force = wheels.wheel_force
    return None if force is None else jnp.linalg.norm(force, axis=-1) / 1000


_QUANTITIES: Mapping[str, Callable[[WheelSignals], Array | None]] = {
    "sinkage, mm": _sinkage,
    "speed, rad/s": operator.attrgetter("wheel_omega"),
    "force, kN": _force,
}
