"""Bounds on the error of a prediction, from how much the parts of the model disagree.

Where models that fail for different reasons disagree, at least one of them is wrong
(Lakshminarayanan et al., 2017, of ensembles): the two specialists, or several gates. How far off a
prediction then is has to be measured on recorded drives. The scale and the quantiles of errors come
from some drives and are tested on others, as in split conformal prediction with normalized scores
(Lei et al., 2018).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from vertiwm_jax.config import Count, CountOrZero, settings
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.evaluation.prediction import TestWindows, predict
from vertiwm_jax.evaluation.tables import Row, markdown, write
from vertiwm_jax.figures import line, sheet, style
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.dataset import Collection, SplitConfig
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.models.registry import load_model

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_log = logging.getLogger(__name__)
LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Shares of predictions that a bound is to hold for."""
PARTS = 5
"""Equal parts of the windows, by disagreement, that are looked at apart."""
_LEAST = 1e-3  # m, of a scale


@settings
class CalibrationTest:
    """How far off predictions of Verti-WM are, by how much its gates or specialists disagree.

    Bounds on the error are found from the validation drives, and tried on the test drives.
    """

    data: Path
    """Folder of `.npz` files of drives, with the maps they name."""
    splits: SplitConfig = SplitConfig()
    """How drives are shared out whose files do not say what they are for."""
    weights: Path | None = None
    """Folder of a fitted model, instead of the one that comes with the package."""
    context: CountOrZero = 16
    """Recorded steps that the model sees first."""
    horizon: Count = 16
    """Steps that it predicts."""
    output: Path | None = None
    """Folder for tables and a picture."""

    def run(self) -> str:
        """Runs the test and writes what `output` asks for; returns the tables as Markdown."""
        lengths = self.context, self.horizon, self.horizon
        collection = Collection.of(self.data, self.splits)
        _log.info("%s", collection)
        splits: tuple[dataset.Split, ...] = ("validation", "test")
        for split in splits:
            dataset.expect_drives([collection], split, self.context + self.horizon)
        model = load_model("vertiwm", self.weights)
        drives = (dataset.load_drives(self.data, split, self.splits) for split in splits)
        windows = (TestWindows.of(*each, *lengths) for each in drives)
        (before, known), (error, disagreement) = (signs(*model, each) for each in windows)
        bounds = {name: Calibration.measure(before, signal) for name, signal in known.items()}
        best = next(iter(bounds))
        tables = parts(error, disagreement[best]), coverage(bounds, error, disagreement)
        text = "\n\n".join(map(markdown, tables))
        if self.output:
            figure = picture(bounds[best], error, disagreement[best], bounds["nothing"])
            write(self.output, {"calibration.md": text + "\n", "calibration.png": figure})
        return text


@dataclass(frozen=True)
class Calibration:
    """A bound on an error e for each level: quantile(level) of e / scale, times the scale.

    line: the scale, m, over the disagreement in a prediction, m, as of `np.polyfit`.
    scores: ratios of errors to their scales, of the drives that it was measured on.
    """

    line: np.ndarray
    scores: np.ndarray

    @classmethod
    def measure(cls, error: np.ndarray, disagreement: np.ndarray) -> Self:
        """From errors and disagreements `[N]`, m; one bound for all if these are equal."""
        line = np.polyfit(disagreement, error, int(np.ptp(disagreement) > 0))
        scale = cls(line, np.empty(0)).scale(disagreement)
        return cls(line, error / scale)

    def scale(self, disagreement: np.ndarray) -> np.ndarray:
        """`[N]` m, the scale of errors at disagreements `[N]`, m."""
        return np.maximum(np.polyval(self.line, disagreement), _LEAST)

    def bound(self, disagreement: np.ndarray, level: float) -> np.ndarray:
        """`[N]` m, what a share `level` of errors is below at disagreements `[N]`, m."""
        return np.quantile(self.scores, level) * self.scale(disagreement)


def signs(
    model: Dynamics, params: Params, test: TestWindows
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Predicts windows, and sums what the model says of its certainty over the predicted steps.

    Args:
        model, params: the model. Its history has to hold `disagreement` and `spread`, as that of
            Verti-WM does.
        test: N windows.

    Returns:
        `[N]` m, position errors after the last step, and `[N]` m by name, the most telling first:
        how much the "gates" disagree, if there are several, and the "specialists"; and zeros as
        "nothing".

    Raises:
        DataError: a prediction is not finite.
    """
    states, read = predict(model, params, test)
    last = np.asarray(test.windows.state[:, -1, :3])
    error = np.linalg.norm(states.position[:, -1] - last, axis=-1)
    if lost := int(np.sum(~np.isfinite(error))):
        raise DataError(f"expected finite predictions, found {lost} of {len(error)} that are not")
    gates = {"gates": read.spread.sum(axis=1)} if np.any(read.spread) else {}
    specialists = read.disagreement.sum(axis=1)
    return error, {**gates, "specialists": specialists, "nothing": np.zeros_like(error)}


def parts(error: np.ndarray, disagreement: np.ndarray) -> list[Row]:
    """A row of errors `[N]`, m, for each equal part of the windows, by disagreement `[N]`, m."""
    return [
        {
            "part of the windows": f"{i} of {PARTS}",
            "disagreement, mm": f"{1000 * disagreement[part].mean():.3f}",
            "mean error, m": f"{error[part].mean():.3f}",
            "95 % of errors below, m": f"{np.quantile(error[part], 0.95):.3f}",
        }
        for i, part in enumerate(_parts(disagreement), 1)
    ]


def coverage(
    bounds: Mapping[str, Calibration], error: np.ndarray, disagreement: Mapping[str, np.ndarray]
) -> list[Row]:
    """A row for each level and calibration: how often its bounds hold for errors `[N]`, m.

    disagreement: `[N]` m, for each calibration. The parts of the windows are by the first of them.
    """
    by_part, rows = _parts(next(iter(disagreement.values()))), []
    for level in LEVELS:
        for name, calibration in bounds.items():
            bound = calibration.bound(disagreement[name], level)
            held = error <= bound
            rows.append(
                {
                    "bound for": f"{level:.0%}",
                    "found from": name,
                    "mean bound, m": f"{bound.mean():.3f}",
                    "held for": f"{held.mean():.1%}",
                    "by part": " / ".join(f"{held[part].mean():.0%}" for part in by_part),
                }
            )
    return rows


def picture(
    calibration: Calibration, error: np.ndarray, disagreement: np.ndarray, constant: Calibration
) -> Figure:
    """Errors over disagreement with their bounds, and how often bounds of any level hold.

    The second panel is of the windows with least and with most disagreement, for bounds that know
    the disagreement and for those that do not. On the diagonal, a bound holds as often as it says.
    """
    by_part, ordered = _parts(disagreement), np.sort(disagreement)
    levels = np.linspace(0.02, 0.98, 49)
    with style():
        figure = sheet(7.2, 3.5)
        left, right = figure.subplots(1, 2)
        left.plot(disagreement, error, ".", color="0.6", markersize=2.5)
        for i, level in enumerate(LEVELS):
            color, dash = line(i)
            bounds = calibration.bound(ordered, level)
            left.plot(ordered, bounds, dash, color=color, label=f"bound for {level:.0%}")
        left.set(xlabel="disagreement [m]", ylabel="position error [m]")
        left.set(xscale="log", yscale="log", ylim=(np.quantile(error, 0.005), None))
        for i, (name, bounds) in enumerate({"": calibration, "not ": constant}.items()):
            for end, part, dash in (("least", by_part[0], "-"), ("most", by_part[-1], "--")):
                limits = [bounds.bound(disagreement[part], level) for level in levels]
                held = [np.mean(error[part] <= limit) for limit in limits]
                label = f"{name}from disagreement, where it is {end}"
                right.plot(levels, held, dash, color=line(i)[0], label=label)
        right.plot([0, 1], [0, 1], color="0.6", linewidth=0.8)
        right.set(xlabel="level of the bound", ylabel="share of errors below it")
        for axes in (left, right):
            axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize=7)
    return figure


def _parts(disagreement: np.ndarray) -> list[np.ndarray]:
    """Rows of the equal parts of windows, from least disagreement to most."""
    return np.array_split(np.argsort(disagreement, kind="stable"), PARTS)
