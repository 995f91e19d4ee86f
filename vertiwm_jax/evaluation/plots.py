"""Plots of drives and of curves, readable in print and by color-blind readers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from vertiwm_jax import figures
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain import picture
from vertiwm_jax.terrain.map import TerrainMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from vertiwm_jax.learning.identification import Identified

Curves = Mapping[str, "tuple[ArrayLike, ArrayLike]"]
"""x and y of lines, by name."""
_MARK: dict[str, Any] = {"color": "black", "markeredgecolor": "white", "linestyle": "none"}


def panels(
    shown: Mapping[str, Curves],
    x_label: str,
    y_label: str = "",
    columns: int = 4,
    first: int = 0,
    sharey: bool = False,
    line_style: Mapping[str, Any] | None = None,
    **settings: Any,
) -> Figure:
    """Draws panels of lines with one legend.

    Args:
        shown: the lines of each panel, by the panel's title.
        x_label, y_label: of all panels.
        columns: panels side by side.
        first: style of the first line, see `figures.line`.
        sharey: whether all panels have the same y axis.
        line_style: options of `Axes.plot`.
        settings: of every panel, for `Axes.set`.

    Returns:
        The figure, which the caller owns.
    """
    columns = min(columns, len(shown))
    rows = math.ceil(len(shown) / columns)
    with figures.style():
        figure = figures.sheet(3.2 * columns, 2.7 * rows + 0.3)
        grid = figure.subplots(rows, columns, squeeze=False, sharey=sharey)
        for axes, (title, lines) in zip(grid.flat, shown.items(), strict=False):
            for i, (name, (x, y)) in enumerate(lines.items(), first):
                color, dash = figures.line(i)
                axes.plot(x, y, dash, color=color, label=name, **(line_style or {}))
            axes.set(title=title, **settings)
        for axes in grid.flat[len(shown) :]:
            axes.set_axis_off()
        figure.supxlabel(x_label, fontsize=9)
        figure.supylabel(y_label, fontsize=9)
        handles, labels = grid.flat[0].get_legend_handles_labels()
        if len(handles) > 1:
            figure.legend(handles, labels, loc="outside upper center", ncols=4)
    return figure


def timed(values: ArrayLike, first: int = 0) -> tuple[np.ndarray, ArrayLike]:
    """Values `[T]` of steps, the first of which is `first`, over their time, s."""
    return STEP_SECONDS * (first + np.arange(np.size(values))), values


def learning_curves(
    metrics: Mapping[str, Mapping[str, Sequence[float]]], x: str, labels: Mapping[str, str]
) -> Figure:
    """One panel for each of `labels`, metric name to title, one line for each run.

    metrics: by run, columns of numbers of equal length by metric name. `x` names the column of
        the horizontal axis. NaN leaves a gap; a run may lack metrics.
    """
    shown = {
        label: {
            run: (table[x], table.get(metric, np.full(len(table[x]), np.nan)))
            for run, table in metrics.items()
        }
        for metric, label in labels.items()
    }
    return panels(shown, x, columns=math.ceil(math.sqrt(len(labels))))


def trajectories(
    terrain: TerrainMap,
    world: int,
    drives: Mapping[str, tuple[np.ndarray, np.ndarray]],
    goal: np.ndarray,
    goal_radius: float,
    risks: Mapping[str, np.ndarray] | None = None,
) -> Figure:
    """Draws drives over the shaded map of one world, with roll and pitch over time beside it.

    drives: by name, positions `[T, 3]` m and roll, pitch, yaw `[T, 3]` rad, all to the one goal
        `[2 or 3]`, m; risks: of some of them, `[T]` probabilities, drawn below if there are any.
    """
    risks = risks or {}
    with figures.style():
        figure = figures.sheet(9.0, 6.2 if risks else 4.6)
        grid = figure.add_gridspec(3 if risks else 2, 2, width_ratios=(1.1, 1))
        overhead = figure.add_subplot(grid[:, 0])
        roll = figure.add_subplot(grid[0, 1])
        pitch = figure.add_subplot(grid[1, 1], sharex=roll)
        lowest = figure.add_subplot(grid[2, 1], sharex=roll) if risks else pitch
        picture.draw_map(overhead, terrain, world, f"world {world}")
        for i, (name, (position, rpy)) in enumerate(drives.items()):
            color, dash = figures.line(i)
            x, y = position[:, 0], position[:, 1]
            overhead.plot(x, y, color="white", linewidth=3.2, alpha=0.8)
            overhead.plot(x, y, dash, label=name, linewidth=1.8, color=color)
            start, end = ("start", "end of a drive") if i == 0 else (None, None)
            overhead.plot(x[-1], y[-1], "s", color=color, markersize=5, label=end)
            overhead.plot(x[0], y[0], "o", **_MARK, markersize=5, label=start)
            for axes, angle in ((roll, rpy[:, 0]), (pitch, rpy[:, 1])):
                axes.plot(*timed(np.degrees(angle)), dash, color=color)
            if name in risks:
                lowest.plot(*timed(risks[name]), dash, color=color)
        draw_goal(overhead, goal, goal_radius)
        roll.set(ylabel="roll [deg], left side up")
        pitch.set(ylabel="pitch [deg], nose down")
        if risks:
            lowest.set(ylabel="risk within 3 s", ylim=(0, 1))
        lowest.set(xlabel="time [s]")
        for axes in {roll, pitch} - {lowest}:
            axes.tick_params(labelbottom=False)
        handles, _ = overhead.get_legend_handles_labels()
        handles.sort(key=lambda line: line.get_label() not in drives)
        legend = [*handles, *picture.ground_legend(terrain, [world])]
        figure.legend(handles=legend, loc="outside upper center", ncols=4)
    return figure


def identified(found: Identified) -> Figure:
    """Draws numbers of a vehicle with 90 % intervals beside those before, and position errors."""
    with figures.style():
        figure = figures.sheet(9.0, 3.4)
        left, right = figure.subplots(1, 2, width_ratios=(1.5, 1))
        for row, number in enumerate(found.numbers):
            known = row == 0
            given = (1 / number.prior, number.prior)
            left.plot(given, (row, row), color="0.8", linewidth=7, label="given" if known else None)
            color, _ = figures.line(0)
            left.plot((number.low, number.high), (row, row), color=color, linewidth=2.5)
            label = "found" if known else None
            left.plot(number.factor, row, "o", color=color, markersize=5, label=label)
        left.set(
            xscale="log",
            xlabel="factor to what was given, with 90 % intervals",
            yticks=range(len(found.numbers)),
            yticklabels=[number.name for number in found.numbers],
        )
        left.set_xticks((ticks := (0.25, 0.5, 1.0, 2.0, 4.0)), [f"{tick:g}" for tick in ticks])
        left.minorticks_off()
        left.invert_yaxis()
        for i, (name, error) in enumerate({"given": found.before, "found": found.after}.items()):
            color, dash = figures.line(1 - i)
            right.plot(*timed(error, 1), dash, color=color, label=f"numbers as {name}")
        right.set(xlabel="time [s]", ylabel="position error [m]", ylim=(0, None))
        for axes in (left, right):
            axes.legend(loc="best")
    return figure


def draw_goal(axes: Axes, goal: np.ndarray, radius: float) -> None:
    """Draws a goal `[2 or 3]`, m, on a map, with the circle in which it is reached."""
    from matplotlib.patches import Circle

    x, y = goal[:2]
    axes.add_patch(Circle((x, y), radius, fill=False, color="black", linewidth=1.2))
    label = f"goal, in a circle of {radius:g} m"
    axes.plot(x, y, "*", **_MARK, markersize=10, zorder=4, label=label)
