"""Plots of drives and of learning curves, readable in print and by color-blind readers."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vertiwm_jax import runs
from vertiwm_jax.env import render
from vertiwm_jax.terrain.map import TerrainMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

# Okabe and Ito (2008), without the yellow that vanishes on paper; dashes tell the rest.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
_DASHES = ("-", "--", "-.", ":")
_MARK: dict[str, Any] = {"color": "black", "markeredgecolor": "white", "linestyle": "none"}
_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "0.88",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "savefig.dpi": 160,
}


def worlds(terrain: TerrainMap, names: Sequence[str] | None = None, most: int = 12) -> Figure:
    """The worlds of a map from above, up to `most` of them, with a legend of their ground.

    names: of all worlds; their numbers by default.
    """
    names = names or [f"world {world}" for world in range(terrain.worlds)]
    shown = range(min(terrain.worlds, most))
    columns = min(len(shown), 4)
    rows = math.ceil(len(shown) / columns)
    size = 4.6 if len(shown) == 1 else 3.0
    with style():
        figure = sheet(size * columns, size * rows + 0.5)
        panels = figure.subplots(rows, columns, squeeze=False)
        for world, axes in zip(shown, panels.flat, strict=False):
            _draw_map(axes, terrain, world, names[world])
        for axes in panels.flat[len(shown) :]:
            axes.set_axis_off()
        legend = _ground_legend(terrain, shown)
        figure.legend(handles=legend, loc="outside upper center", ncols=min(len(legend), 6))
    return figure


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
    with style():
        figure = sheet(9.0, 4.6)
        grid = figure.add_gridspec(2, 2, width_ratios=(1.1, 1))
        overhead = figure.add_subplot(grid[:, 0])
        roll = figure.add_subplot(grid[0, 1])
        pitch = figure.add_subplot(grid[1, 1], sharex=roll)
        _draw_map(overhead, terrain, world, f"world {world}")
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
            colour, dash = line(i)
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
        handles += _ground_legend(terrain, [world])
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
    with style():
        columns = math.ceil(math.sqrt(len(labels)))
        rows = math.ceil(len(labels) / columns)
        figure = sheet(3.2 * columns, 2.5 * rows + 0.3)
        panels = figure.subplots(rows, columns, squeeze=False, sharex=True)
        for axes, (metric, label) in zip(panels.flat, labels.items(), strict=False):
            for i, (run, table) in enumerate(metrics.items()):
                colour, dash = line(i)
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


def save(figure: Figure, path: str | Path) -> None:
    """Writes a figure in the format of its ending, as a whole or not at all; raises `RunError`."""
    image = io.BytesIO()
    with style():
        figure.savefig(image, format=Path(path).suffix[1:])
    runs.write_atomic(path, image.getvalue())


def line(i: int) -> tuple[str, str]:
    """Color and dash of the i-th line of a plot."""
    return _COLOURS[i % len(_COLOURS)], _DASHES[i % len(_DASHES)]


def _draw_map(axes: Axes, terrain: TerrainMap, world: int, title: str) -> None:
    axes.imshow(render.shaded(terrain, world), extent=render.extent(terrain))
    axes.grid(False)
    axes.set(xlabel="x [m], east", ylabel="y [m], north", title=title)


def _ground_legend(terrain: TerrainMap, shown: Sequence[int]) -> list[Patch]:
    """A color for each class of ground in some worlds, and for obstacles."""
    from matplotlib.patches import Patch

    present = np.unique(np.asarray(terrain.semantic)[list(shown)])
    colors = render.pale(np.asarray(terrain.class_rgb))
    legend = [Patch(facecolor=tuple(colors[k]), label=terrain.class_names[k]) for k in present]
    if (np.asarray(terrain.obstacles)[list(shown), :, 4] > 0).any():
        legend.append(Patch(facecolor=str(render.OBSTACLE), label="rock or tree"))
    return legend


def _circle(centre: np.ndarray, radius: float):
    from matplotlib.patches import Circle

    return Circle((centre[0], centre[1]), radius, fill=False, color="black", linewidth=1.2)


# Imported when the first picture is drawn: training should not wait for matplotlib.
def style():
    """A context with the style of all plots."""
    import matplotlib

    return matplotlib.rc_context(_STYLE)


def sheet(width: float, height: float) -> Figure:
    """An empty figure of this size in inches."""
    from matplotlib.figure import Figure

    # Not made by pyplot: belongs to no window and is freed with its last reference.
    return Figure(figsize=(width, height), layout="constrained")
