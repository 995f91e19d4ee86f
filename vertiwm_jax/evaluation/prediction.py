"""Open-loop prediction error of dynamics models on recorded drives."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax import geometry
from vertiwm_jax.dynamics import Dynamics, History, Params, disagreement, spread
from vertiwm_jax.evaluation.published import POSITION_ERRORS
from vertiwm_jax.evaluation.tables import markdown
from vertiwm_jax.learning import windows as recorded
from vertiwm_jax.learning.dataset import Drives, WheelSignals
from vertiwm_jax.learning.objectives import open_loop
from vertiwm_jax.learning.windows import GROUNDS, Windows
from vertiwm_jax.mechanics.simulator import SimulatorHistory
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model.alone import AloneHistory
from vertiwm_jax.world_model.nesam import NesamHistory
from vertiwm_jax.world_model.verti_wm import VertiWMHistory

MEASURES = {
    "position": "m",
    "horizontal": "m",
    "height": "m",
    "roll": "deg",
    "pitch": "deg",
    "yaw": "deg",
}
"""Absolute errors and their units; position is the distance in space."""
BATCH = 512
"""Windows that are predicted at once, which bounds the memory."""


@dataclass(frozen=True)
class TestWindows:
    """Windows of drives to predict.

    drive: `[N]` index of the drive that each is from. Windows of a drive are much alike, so
    intervals are drawn over drives.
    """

    __test__ = False  # the name starts as pytest's classes do

    windows: Windows
    drive: np.ndarray
    terrain: TerrainMap

    @classmethod
    def of(
        cls, drives: Drives, terrain: TerrainMap, context: int, horizon: int, stride: int
    ) -> "TestWindows":
        """All windows of the drives; raises what `windows.index` raises."""
        index = recorded.index(drives, terrain, context, horizon, stride)
        return cls(recorded.gather(drives, index), np.asarray(index.drive), terrain)

    def __len__(self) -> int:
        return len(self.drive)


@dataclass(frozen=True)
class Interval:
    """A mean with its 95 % bootstrap interval."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class PredictionErrors:
    """Errors of one model after so many steps, the horizon.

    final: by measure and then by kind of ground, mean absolute error after the last step.
    growth: by kind of ground, mean position error after each step, m.
    count: by kind of ground, windows.
    diverged: windows whose prediction is not finite; they enter as if the model had not moved.
    """

    name: str
    horizon: int
    final: dict[str, dict[str, Interval]]
    growth: dict[str, list[float]]
    count: dict[str, int]
    diverged: int


class Reading(NamedTuple):
    """What a model tells of itself after a step; None for what it does not have.

    coefficients: `[4]` of the fusion. disagreement, spread: `[]` m, of specialists and of gates.
    wheels: leaves `[4, ...]`.
    """

    coefficients: Any
    disagreement: Any
    spread: Any
    wheels: WheelSignals | None

    @classmethod
    def of(cls, history: History) -> Self:
        """Read from the history after the step."""
        alpha = getattr(history, "coefficients", None)
        return cls(alpha, disagreement(history), spread(history), modelled(history))


def modelled(history: History) -> WheelSignals | None:
    """What a model keeps of its wheels, if it has any; forces are of the last sub-step."""
    match history:
        case VertiWMHistory(nesam=specialist) | AloneHistory(specialist=specialist):
            return modelled(specialist)
        case NesamHistory(simulator=memory):
            return modelled(memory)
        case SimulatorHistory(wheel_speed=speed, sinkage=sinkage, force=force):
            return WheelSignals(wheel_omega=speed, wheel_sinkage=sinkage, wheel_force=force)
    return None


class Predicted(NamedTuple):
    """The K states predicted in N windows, leaves `[N, K, 3]`, and what was read after each."""

    states: VehicleState
    read: Reading


def predict(dynamics: Dynamics, params: Params, test: TestWindows) -> Predicted:
    """Open-loop predictions of every window, in host memory.

    The history is warmed up on the recorded context; from its last state on, the model sees its
    own predictions and the recorded commands (the paper's protocol, Sec. V-A).
    """
    return jax.device_get(_predict(dynamics, params, test.terrain, test.windows))


@partial(jax.jit, static_argnames="dynamics")
def _predict(
    dynamics: Dynamics, params: Params, terrain: TerrainMap, windows: Windows
) -> Predicted:
    def one(window: Windows) -> Predicted:
        ground = terrain.select(window.world)
        return Predicted(*open_loop(dynamics, params, ground, window, Reading.of))

    return jax.lax.map(one, windows, batch_size=BATCH)


def absolute_errors(
    predicted: VehicleState, test: TestWindows
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """By measure, `[N, K]` in its unit, and `[N]` bool, whether the prediction diverged."""
    windows = test.windows
    truth = windows.state[:, windows.context + 1 :, :6]
    start = windows.state[:, windows.context, None, :6]
    pose = jnp.concatenate([predicted.position, predicted.rpy], axis=-1)
    lost = ~jnp.all(jnp.isfinite(pose), axis=(1, 2))
    difference = jnp.where(lost[:, None, None], start, pose) - truth
    turn = jnp.degrees(jnp.abs(geometry.wrap(difference[..., 3:])))
    errors = {
        "position": jnp.linalg.norm(difference[..., :3], axis=-1),
        "horizontal": jnp.linalg.norm(difference[..., :2], axis=-1),
        "height": jnp.abs(difference[..., 2]),
        "roll": turn[..., 0],
        "pitch": turn[..., 1],
        "yaw": turn[..., 2],
    }
    return {name: np.asarray(error) for name, error in errors.items()}, np.asarray(lost)


def evaluate(name: str, dynamics: Dynamics, params: Params, test: TestWindows) -> PredictionErrors:
    """Errors of a model after the last step of every window, by kind of ground."""
    return summary(name, predict(dynamics, params, test).states, test)


def summary(
    name: str, predicted: VehicleState, test: TestWindows, horizon: int | None = None
) -> PredictionErrors:
    """Errors of predictions after `horizon` steps, by default all of them, by kind of ground."""
    errors, lost = absolute_errors(predicted, test)
    horizon = int(horizon or errors["position"].shape[1])
    ground = np.asarray(test.windows.ground)
    rows = {kind: ground == i for i, kind in enumerate(GROUNDS) if (ground == i).any()}
    final = {
        measure: {
            kind: bootstrap(error[row, horizon - 1], test.drive[row]) for kind, row in rows.items()
        }
        for measure, error in errors.items()
    }
    position = errors["position"][:, :horizon]
    growth = {kind: position[row].mean(axis=0).tolist() for kind, row in rows.items()}
    count = {kind: int(row.sum()) for kind, row in rows.items()}
    return PredictionErrors(name, horizon, final, growth, count, int(lost.sum()))


def prediction_errors(
    dynamics: Dynamics,
    params: Params,
    drives: Drives,
    terrain: TerrainMap,
    *,
    context: int = 16,
    horizon: int = 16,
    stride: int = 16,
    name: str = "model",
) -> PredictionErrors:
    """Measures how far off a model's open-loop predictions of recorded drives are.

    Args:
        dynamics, params: the model, and its parameters.
        drives, terrain: of `load_drives`.
        context: recorded steps of 0.1 s that the model sees first.
        horizon: steps that it then predicts from recorded commands alone.
        stride: steps from one window to the next.
        name: what the model is called.

    Returns:
        Mean absolute errors after the last step, with 95 % intervals, by measure (m and degrees)
        and by kind of ground.

    Raises:
        DataError: no drive is long enough.
    """
    test = TestWindows.of(drives, terrain, context, horizon, stride)
    return evaluate(name, dynamics, params, test)


def format_table(rows: Sequence[PredictionErrors], measure: str) -> str:
    """A Markdown table of one measure, one model a row; the paper's figures where it has them."""
    kinds = list(rows[0].count)
    published = [_published(row, measure) for row in rows]
    heads = ["model", *(f"{kind} (n = {rows[0].count[kind]})" for kind in kinds), "diverged"]
    heads += [f"the paper, 16 steps: {' / '.join(kinds)}"] if any(published) else []
    lines = []
    for row, paper in zip(rows, published, strict=True):
        found = [row.final[measure][kind] for kind in kinds]
        cells = [row.name, *(f"{x.mean:.3f} ({x.low:.3f}-{x.high:.3f})" for x in found)]
        cells.append(str(row.diverged))
        if any(published):
            figures = [f"{paper[kind]:.3f}" if kind in paper else "-" for kind in kinds]
            cells.append(" / ".join(figures) if paper else "")
        lines.append(cells)
    title = f"{rows[0].horizon}-step {measure} error, {MEASURES[measure]}"
    return f"{title}: mean and 95 % interval over drives\n\n{markdown(heads, lines)}"


def csv_lines(rows: Sequence[PredictionErrors]) -> list[Mapping[str, str | float]]:
    """One line for each model, measure and kind of ground."""
    return [
        {
            "model": row.name,
            "steps": row.horizon,
            "measure": measure,
            "unit": MEASURES[measure],
            "ground": kind,
            "windows": row.count[kind],
            "mean": x.mean,
            "low": x.low,
            "high": x.high,
            "paper": _published(row, measure).get(kind, ""),
        }
        for row in rows
        for measure, by_kind in row.final.items()
        for kind, x in by_kind.items()
    ]


def _published(row: PredictionErrors, measure: str) -> dict[str, float]:
    return POSITION_ERRORS.get(row.name, {}) if measure == "position" else {}


def bootstrap(values: np.ndarray, groups: np.ndarray, draws: int = 1000) -> Interval:
    """The mean of values `[n]`, and its interval when whole groups `[n]` are drawn again."""
    names, member = np.unique(groups, return_inverse=True)
    sums, sizes = np.bincount(member, values), np.bincount(member)
    drawn = np.random.default_rng(0).integers(0, len(names), (draws, len(names)))
    means = sums[drawn].sum(axis=1) / sizes[drawn].sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return Interval(float(values.mean()), float(low), float(high))
