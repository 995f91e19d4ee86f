"""The test of predictions: its settings, its tables and its pictures."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jax.tree_util import Partial

from vertiwm_jax import atomic
from vertiwm_jax.config import AtLeastOne, Count, CountOrZero, settings
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.evaluation import error_sources, plots, prediction, yardsticks
from vertiwm_jax.evaluation.prediction import Predicted, TestWindows
from vertiwm_jax.evaluation.tables import csv_text, markdown, write
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.dataset import Collection, SplitConfig
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.kinematic import (
    ConstantVelocity,
    DifferentialDrive,
    KinematicBicycle,
    bicycle_of,
    differential_of,
)
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.models import files
from vertiwm_jax.models.config import SoilSource
from vertiwm_jax.models.registry import ModelName, load_fitted, load_model, moves_any, moving
from vertiwm_jax.runs import Progress
from vertiwm_jax.world_model.fusion import COEFFICIENTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_log = logging.getLogger(__name__)
Models = Annotated[tuple[ModelName, ...], AtLeastOne]
SHARES = (0.25, 0.5, 0.75, 0.95)
"""Windows that are pictured: those than which this share of all on such ground err less."""
AROUND = 8
"""Steps before and after a crossing in which fusion coefficients are pictured."""


@settings
class PredictionTest:
    """Open-loop prediction errors of models on recorded drives.

    The built-in simulator, a kinematic bicycle and constant velocity are always beside them.
    """

    data: tuple[Path, ...]
    """Folders of `.npz` files of drives, with the maps they name."""
    models: Models = ("vertiwm", "nesam", "transformer")
    """The models."""
    weights: Path | None = None
    """Folder of a fitted model, or the name of one that comes with the package, `pretrained` or
    `any_vehicle`. By default the first where the HMMWV drives, and the second elsewhere."""
    vehicle: str | None = None
    """What the built-in simulator, the bicycle and learned models of any vehicle drive: the name
    of a shipped vehicle, or a YAML file of one. By default the vehicle that each file of drives
    describes, or else the HMMWV, and of learned models the one that they were fitted to."""
    soil: SoilSource | None = None
    """Where the models have soils from, if not from where they had them when they were fitted."""
    ruts: bool = False
    """Whether soil remembers, from the context on, how deep wheels have pressed it."""
    compare: tuple[Path, ...] = ()
    """Run folders of `fit`, of which each part is a row."""
    split: dataset.Split | None = None
    """Which of the drives; by default those to test, or all of too few to share out. `unseen` are
    all of the worlds that are left out of fits."""
    splits: SplitConfig = dataset.FITTED
    """How drives are shared out whose files do not say what they are for, and which worlds are left
    out of fits."""
    context: CountOrZero = 16
    """Recorded steps that a model sees first."""
    horizons: Annotated[tuple[Count, ...], AtLeastOne] = (16,)
    """Steps that it predicts; there are tables for each number of steps, of all windows for which
    drives are long enough."""
    stride: Count = 16
    """Steps from one window to the next."""
    output: Path | None = None
    """Folder for tables and pictures, also of where and how the first model errs."""
    json: Path | None = None
    """File for all errors as a JSON list of rows."""

    def run(self) -> str:
        """Runs the test and writes what is asked for; returns the tables as Markdown."""
        collections = [Collection.of(folder, self.splits) for folder in self.data]
        divided = any(collection.divided for collection in collections)
        split = self.split or ("test" if divided else "all")
        for collection in collections:
            _log.info("%s; predicted: %s", collection, split)
        dataset.expect_drives(collections, split, self.context + max(self.horizons))
        given = vehicle.load(self.vehicle or vehicle.HMMWV).vehicle
        learned = self._models(self.weights) if self.weights else {}
        for folder in self.compare:
            fitted = load_fitted(folder / "model", ruts=self.ruts)
            learned |= {f"{folder.name}: {part}": model for part, model in fitted.items()}
        drives, terrain = dataset.load_drives(self.data, split, self.splits)
        if self.vehicle:
            drives = replace(drives, described=(None,) * terrain.worlds)
        driven = drives.driven(given)
        if not self.weights:
            shipped = files.ANY_VEHICLE if any(drives.described) else files.shipped(given)
            learned = self._models(shipped) | learned
        models: dict[str, tuple[Dynamics, Params | Partial, Vehicle | None]] = {}
        for name, (dynamics, params) in learned.items():
            if params.vehicle.turn != drives.turn:
                _log.info("%s is left out: it drives a vehicle that is steered otherwise", name)
            elif moves_any(dynamics):
                own = driven if self.vehicle else drives.driven(params.vehicle)
                models[name] = dynamics, Partial(moving, params), own
            else:
                models[name] = dynamics, params, None
        models["builtin"] = Simulator(ruts=self.ruts), Partial(chrono_like), driven
        if driven.skid is None:
            models["kinematic bicycle"] = KinematicBicycle(), Partial(bicycle_of), driven
        else:
            models["differential drive"] = DifferentialDrive(), Partial(differential_of), driven
        models["constant velocity"] = ConstantVelocity(), None, None
        every, tests = TestWindows.nested(drives, terrain, self.context, self.horizons, self.stride)
        predicted = {}
        with Progress(len(models), "models") as progress:
            for name, (dynamics, params, own) in models.items():
                predicted[name] = prediction.predict(dynamics, params, every, own)
                progress.advance(1, f"{name}, {len(every.drive):,} windows")
        found, tables = [], []
        for steps, (rows, test) in tests.items():
            cut = {name: each.cut(rows, steps) for name, each in predicted.items()}
            made = [
                row
                for name, each in cut.items()
                for row in yardsticks.rows(name, each.states, test, split)
            ]
            found += made
            tables.append(yardsticks.table(made))
            if self.output and steps == max(tests):
                drawn = {name: cut[name] for name in self.models if name in cut}
                drawn = drawn or {"builtin": cut["builtin"]}
                growth = {
                    name: prediction.summary(name, each.states, test).growth
                    for name, each in cut.items()
                }
                written = {"prediction.csv": csv_text([vars(row) for row in found])}
                written |= {"prediction.png": error_growth(growth)}
                write(self.output, written | dict(_files(tables, test, drawn)))
        if self.json:
            atomic.write(self.json, yardsticks.json_text(found))
        return "\n\n".join(tables)

    def _models(self, weights: Path) -> dict[str, tuple[Dynamics, Params]]:
        """The models that are asked for, but for the simulator, with these weights."""
        return {
            name: load_model(name, weights, soil=self.soil, ruts=self.ruts)
            for name in self.models
            if name != "builtin"
        }


def _files(
    tables: Sequence[str], test: TestWindows, predicted: Mapping[str, Predicted]
) -> Iterable[tuple[str, str | Figure]]:
    """The tables, with where and how the first model errs, and pictures of it, by file name.

    predicted: by the models whose paths are drawn, over the longest horizon.
    """
    name, (states, read) = next(iter(predicted.items()))
    error = prediction.absolute_errors(states, test)[0]["position"][:, -1]
    shares = markdown(error_sources.shares(test, error))
    tables = [*tables, f"Position error of {name}, where it is", shares]
    if of_wheels := error_sources.wheels(read.wheels, test):
        steps = states.position.shape[1]
        title = f"Wheels of {name} after {steps} steps, beside those recorded"
        tables += [title, markdown(of_wheels)]
    yield "prediction.md", "\n\n".join(tables) + "\n"
    yield "paths.png", paths(_chosen(test, error, predicted))
    if read.coefficients is not None and (traces := crossings(test, read.coefficients)):
        yield "coefficients.png", coefficients(traces)


def _chosen(
    test: TestWindows, error: np.ndarray, predicted: Mapping[str, Predicted]
) -> dict[str, plots.Curves]:
    """On every kind of ground, windows that are predicted well to badly, for `paths`."""
    c, state = test.windows.context, np.asarray(test.windows.state)
    lines = {"recorded": state[:, c:, :2]}
    for name, (states, _) in predicted.items():
        lines[name] = np.concatenate([state[:, c, None, :2], states.position[..., :2]], axis=1)
    chosen = {}
    for kind, members in test.of_ground.items():
        found = np.flatnonzero(members)
        ordered = found[np.argsort(error[found])]
        for share in SHARES:
            row = ordered[int(share * (len(ordered) - 1))]
            title = f"{kind}: {share:.0%} below {error[row]:.2f} m"
            chosen[title] = {name: ahead(state[row, c], path[row]) for name, path in lines.items()}
    return chosen


def ahead(start: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far to the right and forward of where a vehicle `[12]` stood a path `[T, 2]` is, m."""
    cos, sin = np.cos(start[5]), np.sin(start[5])
    x, y = (path - start[:2]).T
    return sin * x - cos * y, cos * x + sin * y


def crossings(test: TestWindows, alphas: np.ndarray) -> dict[str, np.ndarray]:
    """Averages fusion coefficients about the crossing of a border of soil, by direction.

    Only windows that cross one border once count.

    Args:
        test: N windows.
        alphas: `[N, K, C]` coefficients of all predicted steps.

    Returns:
        `[2 AROUND + 1, C]` for each direction, NaN where no window reaches.
    """
    driven = test.windows.state[:, test.windows.context :, :2]
    soft = np.asarray(test.terrain.deformable)[test.classes(driven)]
    changed = soft[:, 1:] != soft[:, :-1]
    padded = np.pad(alphas, [(0, 0), (AROUND, AROUND), (0, 0)], constant_values=np.nan)
    traces = {}
    for title, onto in (("onto soil", True), ("off soil", False)):
        rows = np.flatnonzero((changed.sum(axis=1) == 1) & (soft[:, -1] == onto))
        if len(rows):
            around = changed[rows].argmax(axis=1)[:, None] + np.arange(2 * AROUND + 1)
            mean = np.ma.masked_invalid(padded[rows[:, None], around]).mean(axis=0)
            traces[f"{title} ({len(rows)} windows)"] = mean.filled(np.nan)
    return traces


def error_growth(growth: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Position error over the time predicted, a panel for each kind of ground.

    growth: by model and then by kind, m after each step.
    """
    shown = {
        kind: {name: plots.timed(of[kind], 1) for name, of in growth.items()}
        for kind in next(iter(growth.values()))
    }
    return plots.panels(shown, "time [s]", "position error [m]", sharey=True, yscale="log")


def paths(windows: Mapping[str, plots.Curves]) -> Figure:
    """Paths seen from above, of `ahead`, a panel for each window; the first is the recorded one."""
    ends = {"marker": "s", "markersize": 3.5, "markevery": [-1]}
    labels = "to the right [m]", "forward [m]"
    return plots.panels(
        windows, *labels, first=-1, line_style=ends, aspect="equal", adjustable="datalim"
    )


def coefficients(traces: Mapping[str, np.ndarray]) -> Figure:
    """Fusion coefficients about the moment in which a border of soil is crossed.

    traces: `[2 T + 1, C]` by direction, the crossing in the middle; NaN where there are none.
    """
    shown = {}
    for title, trace in traces.items():
        curves = [plots.timed(values, -(len(trace) // 2)) for values in trace.T]
        shown[title] = dict(zip(COEFFICIENTS, curves, strict=True))
    labels = "time since the crossing [s]", "0 Transformer, 1 NeSAM"
    figure = plots.panels(shown, *labels, sharey=True)
    for axes in figure.axes:
        axes.axvline(0.0, color="0.6", linewidth=0.8)
    return figure
