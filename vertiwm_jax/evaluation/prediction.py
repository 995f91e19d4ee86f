"""Open-loop prediction error of dynamics models on recorded drives."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jax.typing import ArrayLike

from vertiwm_jax import geometry
from vertiwm_jax.dynamics import Dynamics, History, Params, disagreement, spread
from vertiwm_jax.evaluation.tables import markdown
from vertiwm_jax.learning import schema
from vertiwm_jax.learning import windows as recorded
from vertiwm_jax.learning.dataset import Drives, WheelSignals
from vertiwm_jax.learning.objectives import open_loop
from vertiwm_jax.learning.windows import GROUNDS, Windows
from vertiwm_jax.mechanics.simulator import SimulatorHistory
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.precision import float32
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap

MEASURES: dict[str, str] = {
    **dict.fromkeys(("position", "horizontal", "height"), "m"),
    **dict.fromkeys(("heading", "tilt"), "rad"),
    "speed": "m/s",
}
"""Absolute errors and their units: position is the distance in space, tilt the angle between the
verticals as the body sees them, whatever its heading, and speed is forward, negative backwards."""
BATCH = 512
"""Windows that are predicted at once, which bounds the memory."""


@dataclass(frozen=True)
class TestWindows:
    """N windows of drives to predict.

    drive: `[N]` index of the drive that each is from. Windows of a drive are much alike, so
        intervals are drawn over drives.
    vehicles: by world, what the vehicle is called that drove there; of none, none is named.
    """

    __test__ = False  # the name starts as pytest's classes do

    windows: Windows
    drive: np.ndarray
    terrain: TerrainMap
    vehicles: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, drives: Drives, terrain: TerrainMap, context: int, horizon: int, stride: int
    ) -> Self:
        """All windows of the drives; raises what `windows.index` raises."""
        index = recorded.index(drives, terrain, context, horizon, stride)
        windows = recorded.gather(drives, index)
        return cls(windows, np.asarray(index.drive), terrain, drives.vehicles)

    @classmethod
    def nested(
        cls,
        drives: Drives,
        terrain: TerrainMap,
        context: int,
        horizons: Sequence[int],
        stride: int,
    ) -> tuple[Self, dict[int, tuple[np.ndarray, Self]]]:
        """Windows that are predicted once and tested after several numbers of steps.

        Returns:
            N windows of the shortest horizon, drawn out to the longest: commands and states beyond
            the end of a drive have no meaning. And by horizon, shortest first, the windows that
            `of` cuts for it alone, and which of the N they are.

        Raises:
            DataError: no drive is long enough for one of the horizons.
        """
        horizons = sorted(horizons)
        index = recorded.index(drives, terrain, context, horizons[0], stride)
        steps = np.asarray(drives.length)[index.drive] - np.asarray(index.start) - context
        tests = {
            each: (np.flatnonzero(steps >= each), cls.of(drives, terrain, context, each, stride))
            for each in horizons
        }
        beyond = [(0, 0), (0, horizons[-1] - horizons[0]), (0, 0)]
        longer = replace(
            drives,
            state=np.pad(drives.state, beyond, "edge"),
            control=np.pad(drives.control, beyond, "edge"),
            wheels=WheelSignals(),
        )
        windows = recorded.gather(longer, replace(index, horizon=horizons[-1]))
        return cls(windows, np.asarray(index.drive), terrain, drives.vehicles), tests

    @property
    def vehicle(self) -> np.ndarray:
        """`[N]` what the vehicle of each is called."""
        names = self.vehicles or (schema.UNNAMED,) * self.terrain.worlds
        return np.array(names)[np.asarray(self.windows.world)]

    @property
    def of_ground(self) -> dict[str, np.ndarray]:
        """`[N]` which windows are of a kind of ground, for each kind that there is."""
        ground = np.asarray(self.windows.ground)
        return {kind: ground == i for i, kind in enumerate(GROUNDS) if (ground == i).any()}

    def classes(self, xy: ArrayLike) -> np.ndarray:
        """`[N, ...]` class of the ground below points `[N, ..., 2]` of the windows' worlds."""
        return np.asarray(_classes(self.terrain, self.windows.world, xy))


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0))
def _classes(terrain: TerrainMap, world: jax.Array, xy: jax.Array) -> jax.Array:
    return query.surface(terrain.select(world), xy).semantic


@dataclass(frozen=True)
class Interval:
    """A mean with its 95 % bootstrap interval."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:.3f} ({self.low:.3f}-{self.high:.3f})"


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
        return cls(alpha, disagreement(history), spread(history), modeled_wheels(history))


def modeled_wheels(history: History) -> WheelSignals | None:
    """Wheel states in the history of a model, if it has any; forces are of the last sub-step."""
    for part in ("nesam", "specialist", "simulator"):
        history = getattr(history, part, history)
    if isinstance(history, SimulatorHistory):
        return WheelSignals(history.wheel_speed, history.sinkage, history.force)
    return None


class Predicted(NamedTuple):
    """The K states predicted in N windows, leaves `[N, K, 3]`, and what was read after each."""

    states: VehicleState
    read: Reading

    def cut(self, rows: np.ndarray, steps: int) -> "Predicted":
        """The first steps in some of the windows."""
        return jax.tree.map(lambda x: x[rows, :steps], self)


def predict(
    dynamics: Dynamics, params: Params | Partial, test: TestWindows, driven: Vehicle | None = None
) -> Predicted:
    """Predicts every window open-loop; the results are in host memory.

    params: of the model, or what makes them of a vehicle.
    driven: that vehicle by world, leaves `[W, ...]`.

    The history is warmed up on the recorded context. From its last state on, the model sees its own
    predictions and the recorded commands (the paper's protocol, Sec. V-A).
    """
    return jax.device_get(_predict(dynamics, params, test.terrain, test.windows, driven))


@partial(jax.jit, static_argnames="dynamics")
def _predict(
    dynamics: Dynamics,
    params: Params | Partial,
    terrain: TerrainMap,
    windows: Windows,
    driven: Vehicle | None,
) -> Predicted:
    def one(window: Windows) -> Predicted:
        ground = terrain.select(window.world)
        own = params
        if isinstance(params, Partial):
            assert driven is not None, "parameters of a vehicle need one"
            own = params(driven.select(window.world))
        return Predicted(*open_loop(dynamics, own, ground, window, Reading.of))

    return jax.lax.map(one, windows, batch_size=BATCH)


def absolute_errors(
    predicted: VehicleState, test: TestWindows
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """By measure, `[N, K]` in its unit, and `[N]` bool, whether the prediction diverged."""
    windows = test.windows
    truth = windows.state[:, windows.context + 1 :]
    start = windows.state[:, windows.context, None]
    found = predicted.vector
    lost = ~jnp.all(jnp.isfinite(found), axis=(1, 2))
    found = jnp.where(lost[:, None, None], start, found)
    difference = found - truth
    position, horizontal = (jnp.linalg.norm(difference[..., :n], axis=-1) for n in (3, 2))
    ours, theirs = _vertical(found), _vertical(truth)
    apart = jnp.linalg.norm(jnp.cross(ours, theirs), axis=-1), jnp.sum(ours * theirs, axis=-1)
    errors = {
        "position": position,
        "horizontal": horizontal,
        "height": jnp.abs(difference[..., 2]),
        "heading": jnp.abs(geometry.wrap(difference[..., 5])),
        "tilt": jnp.arctan2(*apart),
        "speed": jnp.abs(difference[..., 6]),
    }
    return {name: np.asarray(errors[name]) for name in MEASURES}, np.asarray(lost)


def _vertical(state: jax.Array) -> jax.Array:
    """`[..., 3]`, the direction up as the body at states `[..., 12]` sees it."""
    roll, pitch = state[..., 3], state[..., 4]
    parts = -jnp.sin(pitch), jnp.cos(pitch) * jnp.sin(roll), jnp.cos(pitch) * jnp.cos(roll)
    return jnp.stack(parts, axis=-1)


def summary(name: str, predicted: VehicleState, test: TestWindows) -> PredictionErrors:
    """Errors of predictions after the last step by kind of ground."""
    errors, lost = absolute_errors(predicted, test)
    members = test.of_ground
    final = {
        measure: {
            kind: bootstrap(error[rows, -1], test.drive[rows]) for kind, rows in members.items()
        }
        for measure, error in errors.items()
    }
    position = errors["position"]
    growth = {kind: position[rows].mean(axis=0).tolist() for kind, rows in members.items()}
    count = {kind: int(rows.sum()) for kind, rows in members.items()}
    return PredictionErrors(name, position.shape[1], final, growth, count, int(lost.sum()))


@float32
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
        Mean absolute errors after the last step, with 95 % intervals, by measure (`MEASURES`, in m,
        rad and m/s) and by kind of ground.

    Raises:
        DataError: no drive is long enough.
    """
    test = TestWindows.of(drives, terrain, context, horizon, stride)
    return summary(name, predict(dynamics, params, test).states, test)


def gain(
    dynamics: Dynamics, before: Params, after: Params, drives: Drives, terrain: TerrainMap
) -> Interval:
    """By how much less a model errs with other parameters, m after 16 steps."""
    test = TestWindows.of(drives, terrain, context=16, horizon=16, stride=16)
    states = (predict(dynamics, params, test).states for params in (before, after))
    worse, better = (absolute_errors(each, test)[0]["position"][:, -1] for each in states)
    return bootstrap(worse - better, np.arange(len(worse)))


def format_table(models: Sequence[PredictionErrors], measure: str) -> str:
    """A Markdown table of one measure, one model a row, one kind of ground a column."""
    rows = []
    for model in models:
        found = model.final[measure].items()
        cells = {f"{kind} (n = {model.count[kind]})": str(error) for kind, error in found}
        rows.append({"model": model.name, **cells, "diverged": model.diverged})
    title = f"{models[0].horizon}-step {measure} error, {MEASURES[measure]}"
    return f"{title}: mean and 95 % interval over drives\n\n{markdown(rows)}"


def bootstrap(values: np.ndarray, groups: np.ndarray, draws: int = 1000) -> Interval:
    """The mean of values `[n]`, and its interval when whole groups `[n]` are drawn again."""
    names, member = np.unique(groups, return_inverse=True)
    sums, sizes = np.bincount(member, values), np.bincount(member)
    drawn = np.random.default_rng(0).integers(0, len(names), (draws, len(names)))
    means = sums[drawn].sum(axis=1) / sizes[drawn].sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return Interval(float(values.mean()), float(low), float(high))
