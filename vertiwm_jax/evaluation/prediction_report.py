"""What a test of predictions leaves behind: tables, pictures, and where the error is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np

from vertiwm_jax import atomic, figures
from vertiwm_jax.evaluation import error_sources, prediction, wheels
from vertiwm_jax.evaluation.prediction import (
    BATCH,
    MEASURES,
    Predicted,
    PredictionErrors,
    TestWindows,
)
from vertiwm_jax.evaluation.tables import csv_text
from vertiwm_jax.learning.windows import GROUNDS, Windows
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model.fusion import COEFFICIENTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHARES = (0.25, 0.5, 0.75, 0.95)
"""Windows that are pictured: those than which this share of all on such ground err less."""
AROUND = 8
"""Steps before and after a crossing in which fusion coefficients are pictured."""
COLUMNS = 4
"""Panels side by side."""


def write(
    folder: Path,
    rows: Sequence[Sequence[PredictionErrors]],
    test: TestWindows,
    predicted: Mapping[str, Predicted],
) -> None:
    """All measures as Markdown and CSV, and pictures.

    rows: of all models, for each horizon, the longest last. predicted: what models predict whose
        paths are drawn; the first of them is looked into.
    """
    folder.mkdir(parents=True, exist_ok=True)
    name, (states, read) = next(iter(predicted.items()))
    error = prediction.absolute_errors(states, test)[0]["position"][:, -1]
    tables = [prediction.format_table(models, measure) for models in rows for measure in MEASURES]
    tables.append(f"Position error of {name}, where it is\n")
    tables.append(error_sources.format_shares(error_sources.locate(test, error)))
    if turning := wheels.compare(read.wheels, test):
        horizon = states.position.shape[1]
        tables.append(f"Wheels of {name} after {horizon} steps, beside those recorded\n")
        tables.append(wheels.format_table(turning))
    atomic.write(folder / "prediction.md", "\n\n".join(tables) + "\n")
    lines = [line for models in rows for line in prediction.csv_lines(models)]
    atomic.write(folder / "prediction.csv", csv_text(lines))

    growth = {row.name: row.growth for row in rows[-1]}
    figures.save(error_growth(growth, STEP_SECONDS), folder / "prediction.png")
    figures.save(paths(_panels(test, error, predicted)), folder / "paths.png")
    if read.coefficients is not None and (traces := crossings(test, read.coefficients)):
        seconds = STEP_SECONDS * np.arange(-AROUND, AROUND + 1)
        figure = coefficients(traces, COEFFICIENTS, seconds)
        figures.save(figure, folder / "coefficients.png")


def _panels(
    test: TestWindows, error: np.ndarray, predicted: Mapping[str, Predicted]
) -> list[tuple[str, dict[str, np.ndarray]]]:
    """On every kind of ground, windows that are predicted well to badly."""
    c, ground = test.windows.context, np.asarray(test.windows.ground)
    state = np.asarray(test.windows.state)
    lines = {"recorded": state[:, c:, :2]}
    for name, (states, _) in predicted.items():
        lines[name] = np.concatenate([state[:, c, None, :2], states.position[..., :2]], axis=1)
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


@jax.jit
def _on_soil(terrain: TerrainMap, windows: Windows) -> jax.Array:
    """`[N, K + 1]` whether there is soil below the recorded vehicle."""

    def one(window: Windows) -> jax.Array:
        world, xy = terrain.select(window.world), window.state[window.context :, :2]
        return terrain.deformable[query.surface(world, xy).semantic]

    return jax.lax.map(one, windows, batch_size=BATCH)


def crossings(test: TestWindows, alphas: np.ndarray) -> dict[str, np.ndarray]:
    """Mean coefficients `[2 AROUND + 1, C]` about the crossing of a border of soil, by direction.

    alphas: `[N, K, C]` of all predicted steps. Only windows that cross once count; NaN
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
        shifted = np.full((len(rows), 2 * AROUND + 1, alphas.shape[-1]), np.nan)
        for i, row in enumerate(rows):
            place = np.arange(-AROUND, AROUND + 1) + changed[row].argmax()
            inside = (place >= 0) & (place < steps)
            shifted[i, inside] = alphas[row, place[inside]]
        count = np.isfinite(shifted).sum(axis=0)
        total = np.nansum(shifted, axis=0)
        mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        traces[f"{title} ({len(rows)} windows)"] = mean
    return traces


def error_growth(
    growth: Mapping[str, Mapping[str, Sequence[float]]], step_seconds: float
) -> Figure:
    """Position error over the time predicted, a panel for each kind of ground.

    growth: by model and then by kind, m after each step.
    """
    kinds = list(next(iter(growth.values())))
    with figures.style():
        figure = figures.sheet(3.2 * len(kinds), 2.8)
        panels = figure.subplots(1, len(kinds), sharey=True, squeeze=False)[0]
        for axes, kind in zip(panels, kinds, strict=True):
            for i, (name, by_kind) in enumerate(growth.items()):
                colour, dash = figures.line(i)
                seconds = step_seconds * (1 + np.arange(len(by_kind[kind])))
                axes.plot(seconds, by_kind[kind], dash, label=name, color=colour)
            axes.set(title=kind, xlabel="time [s]", xlim=(0, None), yscale="log")
        panels[0].set_ylabel("position error [m]")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return figure


def paths(panels: Sequence[tuple[str, Mapping[str, np.ndarray]]]) -> Figure:
    """Paths seen from above, a panel for each window: its title, and `[T, 2]` m by name.

    x is forward, drawn upwards, and y to the left. The first of each panel is the recorded one.
    """
    with figures.style():
        rows = math.ceil(len(panels) / COLUMNS)
        figure = figures.sheet(2.4 * COLUMNS, 2.5 * rows + 0.3)
        grid = figure.subplots(rows, COLUMNS, squeeze=False)
        for axes, (title, lines) in zip(grid.flat, panels, strict=False):
            for i, (name, path) in enumerate(lines.items()):
                colour, dash = ("black", "-") if i == 0 else figures.line(i - 1)
                ends = "o" if i == 0 else "s"
                axes.plot(-path[:, 1], path[:, 0], dash, color=colour, label=name)
                axes.plot(-path[-1, 1], path[-1, 0], ends, color=colour, markersize=3.5)
            axes.set_title(title, fontsize=8)
            axes.set_aspect("equal", adjustable="datalim")
        for axes in grid.flat[len(panels) :]:
            axes.set_axis_off()
        figure.supxlabel("to the right [m]")
        figure.supylabel("forward [m]")
        handles = grid.flat[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside upper center", ncols=len(handles[0]))
    return figure


def coefficients(
    traces: Mapping[str, np.ndarray], groups: Sequence[str], seconds: np.ndarray
) -> Figure:
    """Fusion coefficients about the moment in which a border of soil is crossed.

    traces: by direction, means `[T, G]`, NaN where there are none; groups: names of the G.
    seconds: `[T]` since the crossing.
    """
    with figures.style():
        figure = figures.sheet(3.6 * len(traces), 2.9)
        panels = figure.subplots(1, len(traces), sharey=True, squeeze=False)[0]
        for axes, (title, trace) in zip(panels, traces.items(), strict=True):
            for i, name in enumerate(groups):
                colour, dash = figures.line(i)
                axes.plot(seconds, trace[:, i], dash, color=colour, label=name)
            axes.axvline(0.0, color="0.6", linewidth=0.8)
            axes.set(title=title, xlabel="time since the crossing [s]")
        panels[0].set_ylabel("0 Transformer, 1 NeSAM")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return figure
