"""Whether what a model is made of, by disagreeing, tells how far off a prediction is, in metres.

Where models that fail for different reasons disagree, one of them is wrong at least
(Lakshminarayanan et al., 2017, of ensembles): the two specialists, or several gates about where
between these the vehicle goes. How far off it is then, recorded drives have to tell: the scale and
the quantiles are measured on some drives, and checked on others, as in split conformal prediction
with normalised scores (Lei et al., 2018).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.evaluation.prediction import TestWindows, predict
from vertiwm_jax.evaluation.tables import markdown
from vertiwm_jax.figures import line, sheet, style
from vertiwm_jax.learning.schema import DataError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Shares of predictions that a bound is to hold for."""
PARTS = 5
"""Equal parts of the windows, by disagreement, that are looked at apart."""
_LEAST = 1e-3  # m, of a scale


@dataclass(frozen=True)
class Calibration:
    """A bound on an error e for each level: quantile(level) of e / scale, times the scale.

    intercept, slope: of the scale, m and m per m, over the disagreement in a prediction.
    scores: errors over their scales, of the drives that it was measured on, in order.
    """

    intercept: float
    slope: float
    scores: np.ndarray

    @classmethod
    def measure(cls, error: np.ndarray, disagreement: np.ndarray | None) -> Self:
        """From errors `[N]`, m, and disagreements `[N]`, m; without these, one bound for all."""
        slope, intercept = 0.0, float(np.mean(error))
        if disagreement is not None:
            slope, intercept = (float(x) for x in np.polyfit(disagreement, error, 1))
        scaled = cls(intercept, slope, np.empty(0))
        scale = scaled.scale(np.zeros_like(error) if disagreement is None else disagreement)
        return cls(intercept, slope, np.sort(error / scale))

    def scale(self, disagreement: np.ndarray) -> np.ndarray:
        """Of errors, m; `[N]` of disagreements `[N]`, m."""
        return np.maximum(self.intercept + self.slope * disagreement, _LEAST)

    def bound(self, disagreement: np.ndarray, level: float) -> np.ndarray:
        """What a share `level` of errors is below, m; `[N]` of disagreements `[N]`, m."""
        return np.quantile(self.scores, level) * self.scale(disagreement)


@dataclass(frozen=True)
class Coverage:
    """How often bounds of one level held.

    level: what they were to hold for; held: share of all windows; parts: `[PARTS]` the same, from
    the windows with least disagreement to those with most; mean_bound: m.
    """

    level: float
    held: float
    parts: tuple[float, ...]
    mean_bound: float


def signs(
    model: Dynamics, params: Params, test: TestWindows
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Position error after the last step, and how much was disagreed before it: `[N]` each, m.

    Disagreement is that of the "gates", if there are several, and of the "specialists", the most
    telling first, summed over the predicted steps; the history of the model has to hold both, as
    Verti-WM's does. `DataError` if a prediction is not finite.
    """
    states, read = predict(model, params, test)
    apart, spread = read.disagreement.sum(axis=1), read.spread.sum(axis=1)
    last = np.asarray(test.windows.state[:, -1, :3])
    error = np.linalg.norm(states.position[:, -1] - last, axis=-1)
    if lost := int(np.sum(~np.isfinite(error))):
        raise DataError(f"expected finite predictions, found {lost} of {len(error)} that are not")
    several = {"gates": spread} if np.any(spread) else {}
    return error, several | {"specialists": apart}


def coverage(
    calibration: Calibration, error: np.ndarray, disagreement: np.ndarray, order: np.ndarray
) -> list[Coverage]:
    """How often its bounds held for errors `[N]`, m, of predictions with disagreements `[N]`, m.

    order: `[N]` what the parts are ordered by.
    """
    parts, rows = _parts(order), []
    for level in LEVELS:
        bound = calibration.bound(disagreement, level)
        held = error <= bound
        by_part = tuple(float(held[part].mean()) for part in parts)
        rows.append(Coverage(level, float(held.mean()), by_part, float(bound.mean())))
    return rows


def format_parts(error: np.ndarray, disagreement: np.ndarray) -> str:
    """A Markdown table of errors `[N]` by disagreements `[N]`, m."""
    parts = _parts(disagreement)
    rows = {
        "disagreement, mm": [1000 * disagreement[part].mean() for part in parts],
        "mean error, m": [error[part].mean() for part in parts],
        "95 % of errors below, m": [np.quantile(error[part], 0.95) for part in parts],
    }
    heads = ["windows", "least disagreement", *[""] * (PARTS - 2), "most"]
    return markdown(heads, ([name, *(f"{x:.3f}" for x in row)] for name, row in rows.items()))


def format_coverage(rows: Mapping[str, Sequence[Coverage]]) -> str:
    """A Markdown table of how often bounds held, by how they were found."""
    heads = ["bound for", "found from", "mean bound, m", "held for", "by disagreement, least first"]
    lines = []
    for at_level in zip(*rows.values(), strict=True):
        for name, row in zip(rows, at_level, strict=True):
            parts = " / ".join(f"{part:.0%}" for part in row.parts)
            held = f"{row.held:.1%}"
            lines.append((f"{row.level:.0%}", name, f"{row.mean_bound:.3f}", held, parts))
    return markdown(heads, lines)


def picture(
    calibration: Calibration, error: np.ndarray, disagreement: np.ndarray, constant: Calibration
) -> Figure:
    """Errors over disagreement with their bounds, and how often bounds of any level hold.

    The second panel is of the fifths with least and with most disagreement, for bounds that know
    of it and for those that do not: on the diagonal, a bound holds as often as it says.
    """
    parts, ordered = _parts(disagreement), np.sort(disagreement)
    levels = np.linspace(0.02, 0.98, 49)
    with style():
        figure = sheet(7.2, 3.5)
        left, right = figure.subplots(1, 2)
        left.plot(disagreement, error, ".", color="0.6", markersize=2.5)
        for i, level in enumerate(LEVELS):
            colour, dash = line(i)
            bounds = calibration.bound(ordered, level)
            left.plot(ordered, bounds, dash, color=colour, label=f"bound for {level:.0%}")
        left.set(xlabel="disagreement [m]", ylabel="position error [m]")
        left.set(xscale="log", yscale="log", ylim=(np.quantile(error, 0.005), None))
        for i, (name, bounds) in enumerate({"": calibration, "not ": constant}.items()):
            colour, _ = line(i)
            for end, rows, dash in (("least", parts[0], "-"), ("most", parts[-1], "--")):
                limits = [bounds.bound(disagreement[rows], level) for level in levels]
                held = [np.mean(error[rows] <= limit) for limit in limits]
                label = f"{name}from disagreement, where it is {end}"
                right.plot(levels, held, dash, color=colour, label=label)
        right.plot([0, 1], [0, 1], color="0.6", linewidth=0.8)
        right.set(xlabel="level of the bound", ylabel="share of errors below it")
        for axes in (left, right):
            axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize=7)
    return figure


def _parts(disagreement: np.ndarray) -> list[np.ndarray]:
    """Rows of the equal parts of windows, from least disagreement to most."""
    return np.array_split(np.argsort(disagreement, kind="stable"), PARTS)
