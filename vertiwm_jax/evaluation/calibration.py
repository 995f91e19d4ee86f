"""Bounds on the error of a prediction, from signs of it that the model itself shows.

Where models that fail for different reasons disagree, at least one of them is wrong
(Lakshminarayanan et al., 2017, of ensembles): the two specialists, or several gates. Where the
predicted way is not as long as commanded, the vehicle slips or climbs, which is hard to predict.
How far off a prediction then is has to be measured on recorded drives. Weights and quantiles come
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
from vertiwm_jax.learning.windows import way
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
"""Equal parts of the windows, by expected error, that are looked at apart."""
_LEAST = 1e-3  # m, of an expected error


@settings
class CalibrationTest:
    """How far off predictions of Verti-WM are, by what it shows of its certainty.

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
    """Errors of N windows, and what the model showed of its certainty.

    error: `[N]` m, of the position after the last step.
    shown: `[N, signs]` m by name, the most telling first. Signs are by how much the predicted way
        is longer or shorter than commanded ("lag"), and how much the "specialists" disagree, and
        the "gates" if there are several, summed over the predicted steps. "nothing" is no sign.
    drive, world: `[N]` of which the windows are; vehicle: `[N]` what drove there is called.
    """

    error: np.ndarray
    shown: Mapping[str, np.ndarray]
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
        gates, specialists = read.spread.sum(axis=1), read.disagreement.sum(axis=1)
        first = np.asarray(windows.state[:, windows.context, None, :3])
        lag = np.abs(windows.commanded_way - way(np.concatenate([first, states.position], axis=1)))
        signs = {"gates and lag": (gates, lag), "gates": (gates,)} if np.any(gates) else {}
        signs |= {"lag": (lag,), "specialists": (specialists,), "nothing": ()}
        shown = {name: np.reshape(each, (-1, len(error))).T for name, each in signs.items()}
        return cls(error, shown, test.drive, np.asarray(windows.world), test.vehicle)

    def rows(self, chosen: np.ndarray) -> Signs:
        """Of some of the windows, `[N]` bool."""
        shown = {name: each[chosen] for name, each in self.shown.items()}
        own = (each[chosen] for each in (self.drive, self.world, self.vehicle))
        return Signs(self.error[chosen], shown, *own)

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
    """A bound on an error e for each level: quantile(level) of e / expected, times the expected.

    weights: `[1 + signs]` of the expected error, which is linear in the signs; the constant first.
    scores: ratios of errors to expected ones, of the drives that it was measured on.
    """

    weights: np.ndarray
    scores: np.ndarray

    @classmethod
    def measure(cls, error: np.ndarray, signs: np.ndarray) -> Self:
        """By least squares, from errors `[N]` and their signs `[N, signs]`, m."""
        weights = np.linalg.lstsq(_with_constant(signs), error)[0]
        return cls(weights, error / cls(weights, np.empty(0)).expected(signs))

    def expected(self, signs: np.ndarray) -> np.ndarray:
        """`[N]` m, the expected error where the signs `[N, signs]`, m, are such."""
        return np.maximum(_with_constant(signs) @ self.weights, _LEAST)

    def quantile(self, level: float) -> float:
        """What a share `level` of the ratios of errors to expected ones is below."""
        return float(np.quantile(self.scores, level))

    def bound(self, signs: np.ndarray, level: float) -> np.ndarray:
        """`[N]` m, what a share `level` of errors is below where signs `[N, signs]` are such."""
        return self.quantile(level) * self.expected(signs)


def parts(error: np.ndarray, expected: np.ndarray) -> list[Row]:
    """A row of errors `[N]`, m, for each equal part of the windows, by expected error `[N]`, m."""
    return [
        {
            "part of the windows": f"{i} of {PARTS}",
            "expected error, m": f"{expected[part].mean():.3f}",
            "mean error, m": f"{error[part].mean():.3f}",
            "95 % of errors below, m": f"{np.quantile(error[part], 0.95):.3f}",
        }
        for i, part in enumerate(_parts(expected), 1)
    ]


def coverage(folds: Sequence[Fold]) -> list[Row]:
    """A row for each level and each choice of signs: how often bounds from them hold.

    The parts of the windows are by the error expected from the first choice; intervals are over
    drives.
    """
    drive = np.concatenate([tried.drive for _, tried in folds])
    error, expected = _tried(folds)
    by_part, rows = _parts(expected), []
    for level in LEVELS:
        for name in folds[0][0].shown:
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
    """`[N]` m, for all windows that bounds are tried on, from one choice of signs."""
    every = zip(_measured(folds, name), folds, strict=True)
    bounds = [found.bound(tried.shown[name], level) for found, (_, tried) in every]
    return np.concatenate(bounds)


def _measured(folds: Sequence[Fold], name: str) -> list[Calibration]:
    return [Calibration.measure(known.error, known.shown[name]) for known, _ in folds]


def _tried(folds: Sequence[Fold]) -> tuple[np.ndarray, np.ndarray]:
    """Errors `[N]`, m, of all windows that bounds are tried on, and those to be expected."""
    best = next(iter(folds[0][0].shown))
    every = zip(_measured(folds, best), folds, strict=True)
    expected = [found.expected(tried.shown[best]) for found, (_, tried) in every]
    return np.concatenate([tried.error for _, tried in folds]), np.concatenate(expected)


def picture(folds: Sequence[Fold]) -> Figure:
    """Errors over those expected with their bounds, and how often bounds of any level hold.

    The second panel is of the windows with the least and the largest expected error, for bounds
    from the signs and for one constant bound. On the diagonal, a bound holds as often as it says.
    """
    (error, expected), best = _tried(folds), next(iter(folds[0][0].shown))
    by_part, ends = _parts(expected), np.array([expected.min(), expected.max()])
    levels = np.linspace(0.02, 0.98, 49)
    with style():
        figure = sheet(7.2, 3.5)
        left, right = figure.subplots(1, 2)
        left.plot(expected, error, ".", color="0.6", markersize=2.5)
        for i, level in enumerate(LEVELS):
            color, dash = line(i)
            ratio = np.mean([found.quantile(level) for found in _measured(folds, best)])
            left.plot(ends, ratio * ends, dash, color=color, label=f"bound for {level:.0%}")
        left.set(xlabel="expected error [m]", ylabel="position error [m]")
        left.set(xscale="log", yscale="log", ylim=(np.quantile(error, 0.005), None))
        for i, (name, kind) in enumerate({best: f"from {best}", "nothing": "constant"}.items()):
            held_by = [error <= _bounds(folds, name, level) for level in levels]
            for size, part, dash in (("small", by_part[0], "-"), ("large", by_part[-1], "--")):
                held = [np.mean(held[part]) for held in held_by]
                label = f"{kind}, {size} expected errors"
                right.plot(levels, held, dash, color=line(i)[0], label=label)
        right.plot([0, 1], [0, 1], color="0.6", linewidth=0.8)
        right.set(xlabel="level of the bound", ylabel="share of errors below it")
        for axes in (left, right):
            axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize=7)
    return figure


def _parts(expected: np.ndarray) -> list[np.ndarray]:
    """Rows of the equal parts of windows, from the least expected error to the largest."""
    return np.array_split(np.argsort(expected, kind="stable"), PARTS)


def _with_constant(signs: np.ndarray) -> np.ndarray:
    """`[N, 1 + signs]`, a column of ones before the signs."""
    return np.concatenate([np.ones((len(signs), 1)), signs], axis=1)
