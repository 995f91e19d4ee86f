"""Bounds on the error of a prediction, from how much the parts of the model disagree.

Where models that fail for different reasons disagree, at least one of them is wrong
(Lakshminarayanan et al., 2017, of ensembles): the two specialists, or several gates. How far off a
prediction then is has to be measured on recorded drives. The scale and the quantiles of errors come
from some drives and are tested on others, as in split conformal prediction with normalized scores
(Lei et al., 2018), each world or vehicle in turn (Barber et al., 2021, "jackknife+", of folds).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from jax.tree_util import Partial

from vertiwm_jax.config import AtLeastOne, Count, CountOrZero, settings
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.evaluation.prediction import Predicted, TestWindows, bootstrap, predict
from vertiwm_jax.evaluation.tables import Row, markdown, write
from vertiwm_jax.figures import line, sheet, style
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.dataset import Collection, Drives, SplitConfig
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.models import files
from vertiwm_jax.models.registry import load_model, moves_any, moving
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain.map import TerrainMap

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

    Bounds on the error are tried on drives of other worlds, or vehicles, than they are found from.
    """

    data: tuple[Path, ...]
    """Folders of `.npz` files of drives, with the maps they name."""
    split: dataset.Split = "test"
    """Which of the drives; `unseen` are all of the worlds that are left out of fits."""
    splits: SplitConfig = dataset.FITTED
    """How drives are shared out whose files do not say what they are for, and which worlds are left
    out of fits."""
    by: Literal["worlds", "vehicles"] = "worlds"
    """Bounds are tried on each world, or vehicle, and found from all others."""
    weights: Path | None = None
    """Folder of a fitted model, or the name of one that comes with the package, `pretrained` or
    `any_vehicle`. By default the second where files describe their vehicles, and else the first."""
    context: CountOrZero = 16
    """Recorded steps that the model sees first."""
    horizons: Annotated[tuple[Count, ...], AtLeastOne] = (16,)
    """Steps that it predicts; there are tables for each number of steps, of all windows for which
    drives are long enough."""
    output: Path | None = None
    """Folder for tables and a picture, which is of the most steps."""

    def run(self) -> str:
        """Runs the test and writes what `output` asks for; returns the tables as Markdown."""
        collections = [Collection.of(folder, self.splits) for folder in self.data]
        for collection in collections:
            _log.info("%s", collection)
        dataset.expect_drives(collections, self.split, self.context + max(self.horizons))
        given = load_model("vertiwm", self.weights) if self.weights else None
        drives, terrain = dataset.load_drives(self.data, self.split, self.splits)
        shipped = files.ANY_VEHICLE if any(drives.described) else files.PRETRAINED
        found = self._signs(*(given or load_model("vertiwm", shipped)), drives, terrain)
        tables, figure = [], None
        for steps, signs in found.items():
            folds = signs.folds(self.by)
            title = f"After {steps * STEP_SECONDS:g} s"
            tables += [title, markdown(parts(*_tried(folds))), markdown(coverage(folds))]
            figure = picture(folds)
        text = "\n\n".join(tables)
        if self.output and figure:
            write(self.output, {"calibration.md": text + "\n", "calibration.png": figure})
        return text

    def _signs(
        self, dynamics: Dynamics, params: Params, drives: Drives, terrain: TerrainMap
    ) -> dict[int, Signs]:
        """By number of steps, of all windows of the drives."""
        given, own = params, None
        if moves_any(dynamics):
            given, own = Partial(moving, params), drives.driven(params.vehicle)
        most = max(self.horizons)
        every, tests = TestWindows.nested(
            drives, terrain, self.context, self.horizons, min(self.horizons)
        )
        _log.info("%d steps are predicted in %s windows", most, f"{len(every.drive):,}")
        predicted = predict(dynamics, given, every, own)
        return {
            steps: Signs.of(predicted.cut(rows, steps), test)
            for steps, (rows, test) in tests.items()
        }


@dataclass(frozen=True)
class Signs:
    """Errors of N windows, and what the model said of its certainty.

    error: `[N]` m, of the position after the last step.
    disagreement: `[N]` m by name, the most telling first: how much the "gates" disagree, if there
        are several, and the "specialists", summed over the predicted steps; and zeros as "nothing".
    drive, world: `[N]` of which the windows are; vehicle: `[N]` what drove there is called.
    """

    error: np.ndarray
    disagreement: Mapping[str, np.ndarray]
    drive: np.ndarray
    world: np.ndarray
    vehicle: np.ndarray

    @classmethod
    def of(cls, predicted: Predicted, test: TestWindows) -> Self:
        """Of predicted windows; raises `DataError` if a prediction is not finite."""
        (states, read), windows = predicted, test.windows
        last = np.asarray(windows.state[:, -1, :3])
        error = np.linalg.norm(states.position[:, -1] - last, axis=-1)
        if lost := int(np.sum(~np.isfinite(error))):
            raise DataError(
                f"expected finite predictions, found {lost} of {len(error)} that are not"
            )
        gates = {"gates": read.spread.sum(axis=1)} if np.any(read.spread) else {}
        told = {**gates, "specialists": read.disagreement.sum(axis=1)}
        told["nothing"] = np.zeros_like(error)
        return cls(error, told, test.drive, np.asarray(windows.world), test.vehicle)

    def rows(self, chosen: np.ndarray) -> Signs:
        """Of some of the windows, `[N]` bool."""
        told = {name: each[chosen] for name, each in self.disagreement.items()}
        own = (each[chosen] for each in (self.drive, self.world, self.vehicle))
        return Signs(self.error[chosen], told, *own)

    def folds(self, by: Literal["worlds", "vehicles"]) -> list[Fold]:
        """The windows of each world or vehicle to try bounds on, with all others to find them.

        Raises `DataError` where there is one alone.
        """
        units = self.world if by == "worlds" else self.vehicle
        names = np.unique(units)
        if len(names) < 2:
            raise DataError(f"by: expected drives of two {by} or more, found of {len(names)}")
        return [(self.rows(units != name), self.rows(units == name)) for name in names]


Fold = tuple[Signs, Signs]
"""Windows that bounds are found from, and those that they are tried on."""


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


def coverage(folds: Sequence[Fold]) -> list[Row]:
    """A row for each level and each kind of disagreement: how often bounds from it hold.

    The parts of the windows are by the first kind; intervals are over drives.
    """
    error, first = _tried(folds)
    drive = np.concatenate([tried.drive for _, tried in folds])
    by_part, rows = _parts(first), []
    for level in LEVELS:
        for name in folds[0][0].disagreement:
            bound = _bounds(folds, name, level)
            held = error <= bound
            share = bootstrap(held, drive)
            rows.append(
                {
                    "bound for": f"{level:.0%}",
                    "found from": name,
                    "mean bound, m": f"{bound.mean():.3f}",
                    "mean errors": f"{bound.mean() / error.mean():.2f}",
                    "held for": f"{share.mean:.1%} ({share.low:.1%}-{share.high:.1%})",
                    "by part": " / ".join(f"{held[part].mean():.0%}" for part in by_part),
                }
            )
    return rows


def _bounds(folds: Sequence[Fold], name: str, level: float) -> np.ndarray:
    """`[N]` m, for all windows that bounds are tried on, from one kind of disagreement."""
    every = zip(_measured(folds, name), folds, strict=True)
    bounds = [found.bound(tried.disagreement[name], level) for found, (_, tried) in every]
    return np.concatenate(bounds)


def _measured(folds: Sequence[Fold], name: str) -> list[Calibration]:
    return [Calibration.measure(known.error, known.disagreement[name]) for known, _ in folds]


def _tried(folds: Sequence[Fold]) -> tuple[np.ndarray, np.ndarray]:
    """Errors and disagreements `[N]`, m, of all windows that bounds are tried on."""
    best = next(iter(folds[0][0].disagreement))
    every = [(tried.error, tried.disagreement[best]) for _, tried in folds]
    error, disagreement = map(np.concatenate, zip(*every, strict=True))
    return error, disagreement


def picture(folds: Sequence[Fold]) -> Figure:
    """Errors over disagreement with their bounds, and how often bounds of any level hold.

    The second panel is of the windows with least and with most disagreement, for bounds that know
    the disagreement and for those that do not. On the diagonal, a bound holds as often as it says.
    """
    (error, disagreement), best = _tried(folds), next(iter(folds[0][0].disagreement))
    by_part, ordered = _parts(disagreement), np.sort(disagreement)
    levels = np.linspace(0.02, 0.98, 49)
    with style():
        figure = sheet(7.2, 3.5)
        left, right = figure.subplots(1, 2)
        left.plot(disagreement, error, ".", color="0.6", markersize=2.5)
        for i, level in enumerate(LEVELS):
            color, dash = line(i)
            bounds = [found.bound(ordered, level) for found in _measured(folds, best)]
            label = f"bound for {level:.0%}"
            left.plot(ordered, np.mean(bounds, axis=0), dash, color=color, label=label)
        left.set(xlabel="disagreement [m]", ylabel="position error [m]")
        left.set(xscale="log", yscale="log", ylim=(np.quantile(error, 0.005), None))
        for i, (name, told) in enumerate({best: "", "nothing": "not "}.items()):
            held_by = [error <= _bounds(folds, name, level) for level in levels]
            for end, part, dash in (("least", by_part[0], "-"), ("most", by_part[-1], "--")):
                held = [np.mean(held[part]) for held in held_by]
                label = f"{told}from disagreement, where it is {end}"
                right.plot(levels, held, dash, color=line(i)[0], label=label)
        right.plot([0, 1], [0, 1], color="0.6", linewidth=0.8)
        right.set(xlabel="level of the bound", ylabel="share of errors below it")
        for axes in (left, right):
            axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize=7)
    return figure


def _parts(disagreement: np.ndarray) -> list[np.ndarray]:
    """Rows of the equal parts of windows, from least disagreement to most."""
    return np.array_split(np.argsort(disagreement, kind="stable"), PARTS)
