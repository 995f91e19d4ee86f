"""What wheels do in open-loop predictions, beside what was recorded of them."""

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.evaluation.tables import markdown
from vertiwm_jax.learning.dataset import Array, WheelSignals
from vertiwm_jax.learning.windows import GROUNDS


@dataclass(frozen=True)
class WheelError:
    """Of one quantity after the last step, over all wheels of the windows on one kind of ground.

    recorded: its mean; error: mean absolute error; both in its unit.
    """

    quantity: str
    ground: str
    recorded: float
    error: float
    correlation: float


def compare(predicted: WheelSignals | None, test: TestWindows) -> list[WheelError]:
    """Sinkage in soil, speed and force of wheels; nothing of what is not modelled or recorded.

    predicted: leaves `[N, K, 4, ...]`, by a model that has wheels.
    """
    recorded, predicted = test.windows.wheels, predicted or WheelSignals()
    found = []
    for name, read in _QUANTITIES.items():
        truth, ours = read(recorded), read(predicted)
        if truth is None or ours is None:
            continue
        truth, ours = np.asarray(truth[:, -1]), np.asarray(ours[:, -1])
        for i, kind in enumerate(GROUNDS):
            rows = np.asarray(test.windows.ground) == i
            # On rigid ground, and on the rigid side of a border, no wheel sinks.
            if rows.any() and (kind == "deformable" or name != _SINKAGE):
                found.append(_error(name, kind, ours[rows].ravel(), truth[rows].ravel()))
    return found


def format_table(errors: Sequence[WheelError]) -> str:
    """A Markdown table."""
    heads = ["wheels", "ground", "recorded mean", "mean error", "correlation"]
    rows = [
        (x.quantity, x.ground, *(f"{y:.3g}" for y in (x.recorded, x.error, x.correlation)))
        for x in errors
    ]
    return markdown(heads, rows)


_SINKAGE = "sinkage, mm"


def _sinkage(wheels: WheelSignals) -> jax.Array | None:
    # A recorded wheel that is in the air is above the ground, a modelled one has not sunk.
    depth = wheels.wheel_sinkage
    return None if depth is None else 1000 * jnp.maximum(depth, 0.0)


def _force(wheels: WheelSignals) -> jax.Array | None:
    force = wheels.wheel_force
    return None if force is None else jnp.linalg.norm(force, axis=-1) / 1000


_QUANTITIES: Mapping[str, Callable[[WheelSignals], Array | None]] = {
    _SINKAGE: _sinkage,
    "speed, rad/s": operator.attrgetter("wheel_omega"),
    "force, kN": _force,
}


def _error(quantity: str, ground: str, ours: np.ndarray, truth: np.ndarray) -> WheelError:
    with np.errstate(invalid="ignore"):  # What never changes goes with nothing.
        correlation = float(np.corrcoef(ours, truth)[0, 1])
    error = float(np.abs(ours - truth).mean())
    return WheelError(quantity, ground, float(truth.mean()), error, correlation)
