"""Pictures of predictions: how errors grow, where they lead, and what the gate does."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from vertiwm_jax.evaluation.plots import line, sheet, style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = 4


def error_growth(
    growth: Mapping[str, Mapping[str, Sequence[float]]], step_seconds: float
) -> Figure:
    """Position error over the time predicted, a panel for each kind of ground.

    growth: by model and then by kind, m after each step.
    """
    kinds = list(next(iter(growth.values())))
    with style():
        figure = sheet(3.2 * len(kinds), 2.8)
        panels = figure.subplots(1, len(kinds), sharey=True, squeeze=False)[0]
        for axes, kind in zip(panels, kinds, strict=True):
            for i, (name, by_kind) in enumerate(growth.items()):
                colour, dash = line(i)
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
    with style():
        rows = math.ceil(len(panels) / COLUMNS)
        figure = sheet(2.4 * COLUMNS, 2.5 * rows + 0.3)
        grid = figure.subplots(rows, COLUMNS, squeeze=False)
        for axes, (title, lines) in zip(grid.flat, panels, strict=False):
            for i, (name, path) in enumerate(lines.items()):
                colour, dash = ("black", "-") if i == 0 else line(i - 1)
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
    with style():
        figure = sheet(3.6 * len(traces), 2.9)
        panels = figure.subplots(1, len(traces), sharey=True, squeeze=False)[0]
        for axes, (title, trace) in zip(panels, traces.items(), strict=True):
            for i, name in enumerate(groups):
                colour, dash = line(i)
                axes.plot(seconds, trace[:, i], dash, color=colour, label=name)
            axes.axvline(0.0, color="0.6", linewidth=0.8)
            axes.set(title=title, xlabel="time since the crossing [s]")
        panels[0].set_ylabel("0 Transformer, 1 NeSAM")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return figure
