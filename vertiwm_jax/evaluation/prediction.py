"""Open-loop prediction error of dynamics models on recorded drives."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.learning.rollouts import open_loop
from vertiwm_jax.learning.windows import GROUNDS, Windows
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain.map import TerrainMap


@partial(jax.jit, static_argnames="dynamics")
def predict(
    dynamics: Dynamics, params: Params, terrain: TerrainMap, windows: Windows
) -> VehicleState:
    """The K states predicted in every window: leaves `[N, K, 3]`.

    The history is warmed up on the recorded context; from its last state on, the model sees its
    own predictions and the recorded commands (the paper's protocol, Sec. V-A).
    """

    def one(window: Windows) -> VehicleState:
        ground = terrain.select(window.world)
        return open_loop(dynamics, params, ground, window, lambda _: None)[0]

    return jax.vmap(one)(windows)


@dataclass(frozen=True)
class PredictionErrors:
    """Mean final position error of one model, m, by kind of ground.

    mean, low, high: by ground, the mean and its 95 % bootstrap interval over windows; count: by
    ground, windows. Windows whose prediction is not finite are counted in `diverged` and enter
    the mean with the distance driven, as if the model had not moved.
    """

    name: str
    mean: dict[str, float]
    low: dict[str, float]
    high: dict[str, float]
    count: dict[str, int]
    diverged: int


def evaluate(
    name: str, dynamics: Dynamics, params: Params, terrain: TerrainMap, windows: Windows
) -> PredictionErrors:
    """Position error after the last step of every window, in 3-D."""
    final = predict(dynamics, params, terrain, windows).position[:, -1]
    truth = windows.state[:, -1, :3]
    error = np.asarray(jnp.linalg.norm(final - truth, axis=-1))
    still = np.asarray(jnp.linalg.norm(windows.state[:, windows.context, :3] - truth, axis=-1))
    finite = np.isfinite(error)
    error, ground = np.where(finite, error, still), np.asarray(windows.ground)
    groups = {kind: error[ground == i] for i, kind in enumerate(GROUNDS) if (ground == i).any()}
    bounds = {kind: _bootstrap(values) for kind, values in groups.items()}
    return PredictionErrors(
        name=name,
        mean={kind: float(values.mean()) for kind, values in groups.items()},
        low={kind: bound[0] for kind, bound in bounds.items()},
        high={kind: bound[1] for kind, bound in bounds.items()},
        count={kind: len(values) for kind, values in groups.items()},
        diverged=int((~finite).sum()),
    )


def format_table(rows: list[PredictionErrors], horizon: int) -> str:
    """A Markdown table, one model a row."""
    kinds = list(rows[0].count)
    counts = [f"{kind} (n = {rows[0].count[kind]})" for kind in kinds]
    lines = [
        f"{horizon}-step position error, m: mean and 95 % interval",
        "",
        "| model | " + " | ".join(counts) + " | diverged |",
        "|" + "---|" * (len(kinds) + 2),
    ]
    for row in rows:
        cells = [f"{row.mean[k]:.3f} ({row.low[k]:.3f}-{row.high[k]:.3f})" for k in kinds]
        lines.append(f"| {row.name} | " + " | ".join(cells) + f" | {row.diverged} |")
    return "\n".join(lines)


def _bootstrap(values: np.ndarray, draws: int = 1000) -> tuple[float, float]:
    rng = np.random.default_rng(0)
    means = values[rng.integers(0, len(values), (draws, len(values)))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)
