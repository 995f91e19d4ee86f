"""Plots of drives and of learning curves, readable in print and by color-blind readers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vertiwm_jax import figures
from vertiwm_jax.terrain import picture
from vertiwm_jax.terrain.map import TerrainMap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARK: dict[str, Any] = {"color": "black", "markeredgecolor": "white", "linestyle": "none"}


def trajectories(
    terrain: TerrainMap,
    world: int,
    drives: Mapping[str, tuple[np.ndarray, np.ndarray]],
    goal: np.ndarray,
    goal_radius: float,
    step_seconds: float,
) -> Figure:
    """Drives over the shaded map of one world, with roll and pitch over time beside it.

    drives: by name, positions `[T, 3]` m and roll, pitch, yaw `[T, 3]` rad, all to the one goal
    `[2 or 3]`. The caller saves and owns the figure; no window is opened.
    """
    with figures.style():
        figure = figures.sheet(9.0, 4.6)
        grid = figure.add_gridspec(2, 2, width_ratios=(1.1, 1))
        overhead = figure.add_subplot(grid[:, 0])
        roll = figure.add_subplot(grid[0, 1])
        pitch = figure.add_subplot(grid[1, 1], sharex=roll)
        picture.draw_map(overhead, terrain, world, f"world {world}")
        overhead.add_patch(_circle(goal, goal_radius))
        overhead.plot(
            *goal[:2],
            "*",
            **_MARK,
            markersize=9,
            zorder=4,
            label=f"goal, in a circle of {goal_radius:g} m",
        )
        for i, (name, (position, rpy)) in enumerate(drives.items()):
            colour, dash = figures.line(i)
            x, y = position[:, 0], position[:, 1]
            overhead.plot(x, y, color="white", linewidth=3.2, alpha=0.8)
            overhead.plot(x, y, dash, label=name, linewidth=1.8, color=colour)
            start, end = ("start", "end of a drive") if i == 0 else (None, None)
            overhead.plot(x[-1], y[-1], "s", color=colour, markersize=5, label=end)
            overhead.plot(x[0], y[0], "o", **_MARK, markersize=5, label=start)
            seconds = step_seconds * np.arange(len(rpy))
            for axes, angle in ((roll, rpy[:, 0]), (pitch, rpy[:, 1])):
                axes.plot(seconds, np.degrees(angle), dash, color=colour)
        roll.set_ylabel("roll [deg], left side up")
        pitch.set_ylabel("pitch [deg], nose down")
        pitch.set_xlabel("time [s]")
        roll.tick_params(labelbottom=False)
        lines = [shown for shown in overhead.lines if not str(shown.get_label()).startswith("_")]
        drawn = [shown for shown in lines if shown.get_label() in drives]
        handles: list[Any] = drawn + [shown for shown in lines if shown not in drawn]
        handles += picture.ground_legend(terrain, [world])
        figure.legend(handles=handles, loc="outside upper center", ncols=4)
    return figure


def learning_curves(
    metrics: Mapping[str, Mapping[str, Sequence[float]]],
    x: str,
    labels: Mapping[str, str],
    x_label: str,
) -> Figure:
    """One panel for each of `labels`, metric name to axis label, one line for each run.

    metrics: by run, columns of numbers of equal length by metric name. `x` names the column of
    the horizontal axis. NaN leaves a gap; a run may lack metrics.
    """
    with figures.style():
        columns = math.ceil(math.sqrt(len(labels)))
        rows = math.ceil(len(labels) / columns)
        figure = figures.sheet(3.2 * columns, 2.5 * rows + 0.3)
        panels = figure.subplots(rows, columns, squeeze=False, sharex=True)
        for axes, (metric, label) in zip(panels.flat, labels.items(), strict=False):
            for i, (run, table) in enumerate(metrics.items()):
                colour, dash = figures.line(i)
                values = table.get(metric, [math.nan] * len(table[x]))
                axes.plot(table[x], values, dash, label=run, color=colour)
            axes.set_ylabel(label)
        for axes in panels.flat[len(labels) :]:
            axes.set_axis_off()
        for axes in panels.flat[max(0, len(labels) - columns) : len(labels)]:
            axes.set_xlabel(x_label)
            axes.tick_params(labelbottom=True)
        if len(metrics) > 1:
            handles = panels.flat[0].get_legend_handles_labels()
            figure.legend(*handles, loc="outside upper center", ncols=4)
    return figure


def _circle(centre: np.ndarray, radius: float):
    from matplotlib.patches import Circle

    return Circle((centre[0], centre[1]), radius, fill=False, color="black", linewidth=1.2)
