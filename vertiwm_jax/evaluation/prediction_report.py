"""What a test of predictions leaves behind: tables, pictures, and where the error is."""

import operator
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import jax
import numpy as np

from vertiwm_jax import runs
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.evaluation import error_sources, plots, prediction, prediction_plots, wheels
from vertiwm_jax.evaluation.prediction import BATCH, MEASURES, PredictionErrors, TestWindows
from vertiwm_jax.learning.rollouts import open_loop
from vertiwm_jax.learning.windows import GROUNDS, Windows
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model.fusion import COEFFICIENTS
from vertiwm_jax.world_model.model import VertiWM, VertiWMParams

SHARES = (0.25, 0.5, 0.75, 0.95)
"""Windows that are pictured: those than which this share of all on such ground err less."""
AROUND = 8
"""Steps before and after a crossing in which fusion coefficients are pictured."""


def write(
    folder: Path,
    rows: Sequence[PredictionErrors],
    test: TestWindows,
    models: Mapping[str, tuple[Dynamics, Params]],
) -> None:
    """All measures as Markdown and CSV, and pictures; the first of the models is looked into."""
    folder.mkdir(parents=True, exist_ok=True)
    name, (best, params) = next(iter(models.items()))
    error = prediction.absolute_errors(best, params, test)[0]["position"][:, -1]
    horizon = test.windows.control.shape[1] - test.windows.context
    tables = [prediction.format_table(rows, measure, horizon) for measure in MEASURES]
    tables.append(f"Position error of {name}, where it is\n")
    tables.append(error_sources.format_shares(error_sources.locate(test, error)))
    if turning := wheels.compare(best, params, test):
        tables.append(f"Wheels of {name} after {horizon} steps, beside those recorded\n")
        tables.append(wheels.format_table(turning))
    runs.write_atomic(folder / "prediction.md", "\n\n".join(tables) + "\n")
    runs.write_atomic(folder / "prediction.csv", runs.csv_text(prediction.csv_lines(rows)))

    growth = {row.name: row.growth for row in rows}
    plots.save(prediction_plots.error_growth(growth, STEP_SECONDS), folder / "prediction.png")
    plots.save(prediction_plots.paths(_panels(test, error, models)), folder / "paths.png")
    if isinstance(best, VertiWM):
        found = _coefficients(best, params, test.terrain, test.windows)
        traces = crossings(test, np.asarray(found))
        if traces:
            seconds = STEP_SECONDS * np.arange(-AROUND, AROUND + 1)
            figure = prediction_plots.coefficients(traces, COEFFICIENTS, seconds)
            plots.save(figure, folder / "coefficients.png")


def _panels(
    test: TestWindows, error: np.ndarray, models: Mapping[str, tuple[Dynamics, Params]]
) -> list[tuple[str, dict[str, np.ndarray]]]:
    """On every kind of ground, windows that are predicted well to badly."""
    c, ground = test.windows.context, np.asarray(test.windows.ground)
    state = np.asarray(test.windows.state)
    lines = {"recorded": state[:, c:, :2]}
    for name, (model, params) in models.items():
        predicted = prediction.predict(model, params, test.terrain, test.windows)
        start = state[:, c, None, :2]
        lines[name] = np.concatenate([start, np.asarray(predicted.position)[..., :2]], axis=1)
    panels = []
    for kind in sorted(set(ground)):
        found = np.flatnonzero(ground == kind)
        ordered = found[np.argsort(error[found])]
        for share in SHARES:
            row = ordered[int(share * (len(ordered) - 1))]
            title = f"{GROUNDS[kind]}: {share:.0%} below {error[row]:.2f} m"
            seen = {name: _ahead(state[row, c], path[row]) for name, path in lines.items()}
            panels.append((title, seen))
    return panels


def _ahead(start: np.ndarray, path: np.ndarray) -> np.ndarray:
    """`[T, 2]` m forward and to the left of where a vehicle `[12]` stood."""
    cos, sin = np.cos(start[5]), np.sin(start[5])
    return (path - start[:2]) @ np.array([[cos, -sin], [sin, cos]])


@partial(jax.jit, static_argnames="model")
def _coefficients(
    model: VertiWM, params: VertiWMParams, terrain: TerrainMap, windows: Windows
) -> jax.Array:
    """`[N, K, 4]` alpha of every predicted step."""

    def one(window: Windows) -> jax.Array:
        world = terrain.select(window.world)
        return open_loop(model, params, world, window, operator.attrgetter("coefficients"))[1]

    return jax.lax.map(one, windows, batch_size=BATCH)


@jax.jit
def _on_soil(terrain: TerrainMap, windows: Windows) -> jax.Array:
    """`[N, K + 1]` whether there is soil below the recorded vehicle."""

    def one(window: Windows) -> jax.Array:
        world, xy = terrain.select(window.world), window.state[window.context :, :2]
        return terrain.deformable[query.surface(world, xy).semantic]

    return jax.lax.map(one, windows, batch_size=BATCH)


def crossings(test: TestWindows, coefficients: np.ndarray) -> dict[str, np.ndarray]:
    """Mean coefficients `[2 AROUND + 1, C]` about the crossing of a border of soil, by direction.

    coefficients: `[N, K, C]` of all predicted steps. Only windows that cross once count; NaN
    where none of them reaches.
    """
    soft = np.asarray(_on_soil(test.terrain, test.windows))
    changed = soft[:, 1:] != soft[:, :-1]
    steps = changed.shape[1]
    traces = {}
    for title, onto in (("onto soil", True), ("off soil", False)):
        rows = np.flatnonzero((changed.sum(axis=1) == 1) & (soft[:, -1] == onto))
        if not len(rows):
            continue
        shifted = np.full((len(rows), 2 * AROUND + 1, coefficients.shape[-1]), np.nan)
        for i, row in enumerate(rows):
            place = np.arange(-AROUND, AROUND + 1) + changed[row].argmax()
            inside = (place >= 0) & (place < steps)
            shifted[i, inside] = coefficients[row, place[inside]]
        count = np.isfinite(shifted).sum(axis=0)
        total = np.nansum(shifted, axis=0)
        mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        traces[f"{title} ({len(rows)} windows)"] = mean
    return traces
