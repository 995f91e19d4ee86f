"""What wheels do in open-loop predictions, beside what was recorded of them."""

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.dynamics import Dynamics, History, Params
from vertiwm_jax.evaluation.prediction import BATCH, TestWindows
from vertiwm_jax.learning.dataset import Array, Auxiliary
from vertiwm_jax.learning.rollouts import open_loop
from vertiwm_jax.learning.windows import GROUNDS, Windows
from vertiwm_jax.mechanics.simulator import SimulatorHistory
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model.model import VertiWMHistory
from vertiwm_jax.world_model.nesam import NesamHistory


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


def compare(dynamics: Dynamics, params: Params, test: TestWindows) -> list[WheelError]:
    """Sinkage in soil, speed and force of wheels; nothing of what is not modelled or recorded."""
    recorded = test.windows.auxiliary
    predicted = _predict(dynamics, params, test.terrain, test.windows) or Auxiliary()
    found = []
    for name, read in _QUANTITIES.items():
        truth, ours = read(recorded), read(predicted)
        if truth is None or ours is None:
            continue
        truth, ours = np.asarray(truth[:, -1]), np.asarray(ours)
        for i, kind in enumerate(GROUNDS):
            rows = np.asarray(test.windows.ground) == i
            # On rigid ground, and on the rigid side of a border, no wheel sinks.
            if rows.any() and (kind == "deformable" or name != _SINKAGE):
                found.append(_error(name, kind, ours[rows].ravel(), truth[rows].ravel()))
    return found


def format_table(errors: Sequence[WheelError]) -> str:
    """A Markdown table."""
    lines = [
        "| wheels | ground | recorded mean | mean error | correlation |",
        "|---|---|---|---|---|",
    ]
    for x in errors:
        cells = x.quantity, x.ground, *(f"{y:.3g}" for y in (x.recorded, x.error, x.correlation))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


_SINKAGE = "sinkage, mm"


def _sinkage(wheels: Auxiliary) -> jax.Array | None:
    # A recorded wheel that is in the air is above the ground, a modelled one has not sunk.
    depth = wheels.wheel_sinkage
    return None if depth is None else 1000 * jnp.maximum(depth, 0.0)


def _force(wheels: Auxiliary) -> jax.Array | None:
    force = wheels.wheel_force
    return None if force is None else jnp.linalg.norm(force, axis=-1) / 1000


_QUANTITIES: Mapping[str, Callable[[Auxiliary], Array | None]] = {
    _SINKAGE: _sinkage,
    "speed, rad/s": operator.attrgetter("wheel_omega"),
    "force, kN": _force,
}


def modelled(history: History) -> Auxiliary | None:
    """What a model keeps of its wheels, if it has any; forces are of the last sub-step."""
    match history:
        case VertiWMHistory(nesam=specialist):
            return modelled(specialist)
        case NesamHistory(simulator=memory):
            return modelled(memory)
        case SimulatorHistory(wheel_speed=speed, sinkage=sinkage, force=force):
            return Auxiliary(wheel_omega=speed, wheel_sinkage=sinkage, wheel_force=force)
    return None


@partial(jax.jit, static_argnames="dynamics")
def _predict(
    dynamics: Dynamics, params: Params, terrain: TerrainMap, windows: Windows
) -> Auxiliary | None:
    """Of the last step, leaves `[N, 4, ...]`."""

    def one(window: Windows) -> Auxiliary | None:
        world = terrain.select(window.world)
        wheels = open_loop(dynamics, params, world, window, modelled)[1]
        return jax.tree.map(lambda x: x[-1], wheels)

    return jax.lax.map(one, windows, batch_size=BATCH)


def _error(quantity: str, ground: str, ours: np.ndarray, truth: np.ndarray) -> WheelError:
    with np.errstate(invalid="ignore"):  # What never changes goes with nothing.
        correlation = float(np.corrcoef(ours, truth)[0, 1])
    error = float(np.abs(ours - truth).mean())
    return WheelError(quantity, ground, float(truth.mean()), error, correlation)
