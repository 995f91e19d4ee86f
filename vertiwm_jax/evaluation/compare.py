"""Policies that are trained in several models and tested all alike, in one table."""

import contextlib
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from vertiwm_jax import atomic, xla
from vertiwm_jax import config as configuration
from vertiwm_jax import runs as run_folders
from vertiwm_jax.config import AtLeastOne, ConfigError, Count, CountOrZero
from vertiwm_jax.env import suites
from vertiwm_jax.env.agent import Agent, Policy
from vertiwm_jax.env.episodes import NavigationResult
from vertiwm_jax.env.suites import SUITES, GroundConfig, Suite
from vertiwm_jax.evaluation import external, navigation, report, tables
from vertiwm_jax.evaluation.report import Results
from vertiwm_jax.models.registry import ModelName
from vertiwm_jax.rl import experiment
from vertiwm_jax.rl.experiment import TRAININGS, TrainConfig
from vertiwm_jax.runs import Run

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Row:
    """One policy of the table."""

    algorithm: Literal["ppo", "sac", "td3"]
    """What trains it."""
    model: ModelName
    """What it is trained inside."""

    def __str__(self) -> str:
        return f"{self.algorithm} in {self.model}"


@configuration.settings
class CompareConfig:
    """Train policies by several algorithms in several models, and test them all alike."""

    GONE: ClassVar[dict[str, str]] = xla.GONE

    rows: tyro.conf.Suppress[tyro.conf.Fixed[Annotated[tuple[Row, ...], AtLeastOne]]]
    """Which policies; in a file only."""
    simulators: Annotated[tuple[external.Arena, ...], AtLeastOne] = ("builtin",)
    """What they are tested in; Chrono needs PyChrono."""
    suites: tuple[Suite, ...] = tuple(SUITES)
    """Kinds of worlds that they are tested on."""
    suite_worlds: Count = 10
    """How many worlds of each."""
    pairs: Count = 10
    """Tasks in a world."""
    jobs: Count = 1
    """Processes that drive, in Chrono."""
    seed: CountOrZero = 0
    """Draws the worlds; how policies are trained has seeds of its own."""
    settings: Path | None = None
    """Folder with `ppo.yaml`, `sac.yaml` and `td3.yaml`, or `paper`, the package's own of the
    paper's trainings; by default those of the package's usual trainings."""
    name: str = "compare"
    """What the name of the run folder begins with; the date follows."""
    runs: Path = Path("runs")
    """Folder in which the folder of this run is made."""
    resume: Path | None = None
    """Folder of an earlier run to go on with; policies that are trained are not trained again."""

    def check(self):
        if len(set(self.rows)) < len(self.rows):
            raise ValueError("rows: expected each of them once, found one again")


def compare(config: CompareConfig) -> str:
    """Trains policies that are not trained yet, and tests all.

    Returns their table as Markdown, which the run folder keeps beside tables and pictures of each
    simulator.
    """
    Run.expect(config)
    settings = {row: training(config, row) for row in config.rows}
    vehicles = {chosen.vehicle for chosen in settings.values()}
    if len(vehicles) > 1:
        names = " and ".join(sorted(vehicles))
        raise ConfigError(f"{config.settings}: vehicle: expected one for all, found {names}")
    first = settings[config.rows[0]]
    for simulator in config.simulators:
        external.expect(simulator, first)
    for row in config.rows:
        experiment.dynamics(settings[row], row.model)  # That it cannot be read is to be said now.
    ground = GroundConfig(
        suites=config.suites, suite_worlds=config.suite_worlds, pairs=config.pairs
    )
    with Run.begin(config, config.name) as run:
        folders = {row: _train(row, settings[row], run.folder) for row in config.rows}
        drivers: list[tuple[TrainConfig, Mapping[str, Policy | Agent]]] = [
            (replace(settings[row], ground=ground), _learned(row, settings[row], folder))
            for row, folder in folders.items()
        ]
        # Controllers see the arcs ahead, whatever policies see.
        seeing = replace(first.navigation, arcs=True, embeddings=False)
        shown = replace(first, ground=ground, navigation=seeing)
        drivers.append((shown, shown.baselines))
        key = experiment.TaskConfig(seed=config.seed).key("worlds")
        terrain = suites.suite_worlds(ground, key, first.driven.scale)
        tested = {}
        for simulator in config.simulators:
            groups: dict[str, dict[str, NavigationResult]] = {}
            where = ground.world_suites, simulator, config.jobs
            for task, policies in drivers:
                driven = report.drive(task, terrain, policies, *where)
                for suite, results in driven.items():
                    groups.setdefault(suite, {}).update(results)
            report.write(run.folder / simulator, groups, terrain, first.navigation.goal_radius)
            tested[simulator] = groups
        table = markdown({str(row): cost(folder) for row, folder in folders.items()}, tested)
        atomic.write(run.folder / "table.md", table + "\n")
    return table


def training(config: CompareConfig, row: Row) -> TrainConfig:
    """The settings that a policy is trained with."""
    folder, kind = config.settings or Path(), TRAININGS[row.algorithm]
    file = folder / f"{kind.name}.yaml"
    if config.settings is None or not folder.exists():
        with contextlib.suppress(ConfigError):
            file = configuration.default_config(str(folder / kind.name))
    return replace(configuration.load(kind, file), model=row.model, planning=None)


def _train(row: Row, settings: TrainConfig, folder: Path) -> Path:
    """The folder of the policy's training, which begins, or goes on from where it was."""
    _log.info("\n%s", row)
    place = folder / str(row).replace(" ", "_")
    begun = max(place.iterdir(), default=None) if place.is_dir() else None
    if begun and (begun / "summary.json").is_file():
        _log.info("trained in %s", begun)
        return begun
    if begun:
        kept = configuration.load(type(settings), begun / "config.yaml")
        settings = replace(settings, compute_dtype=kept.compute_dtype)
    trained, run, held_out = experiment.run(replace(settings, runs=place, resume=begun))
    _log.info("\n%s\n", report.after_training(trained, run, held_out))
    return run


def _learned(row: Row, settings: TrainConfig, folder: Path) -> dict[str, Policy | Agent]:
    """The policies of a training, by their names in the table."""
    found = experiment.learned(settings, folder)
    return {name.replace(row.algorithm, str(row), 1): policy for name, policy in found.items()}


def cost(folder: Path) -> tuple[float, int]:
    """Seconds, and steps of 0.1 s, of the training in a folder; compilation and tests do not count.

    All sessions of the training count.
    """
    columns = run_folders.read_columns(folder)
    steps, rates = columns["timesteps"], columns["timesteps_per_second"]
    each = steps[-1] / len(steps)
    return sum(each / rate for rate in rates), int(steps[-1])


def markdown(
    costs: Mapping[str, tuple[float, int]], tested: Mapping[str, Mapping[str, Results]]
) -> str:
    """A table for each simulator: costs of trained policies, and how all policies drive by suite.

    That is: successes, their mean time, and mean absolute roll and pitch.
    """
    sections = []
    for simulator, groups in tested.items():
        rows = []
        for policy in next(iter(groups.values())):
            spent = [cost for name, cost in costs.items() if policy.startswith(name)]
            told = [(f"{seconds / 60:.1f}", f"{steps / seconds:,.0f}") for seconds, steps in spent]
            minutes, rate = told[0] if told else ("", "")
            row = {"policy": policy, "training [min]": minutes, "steps/s": rate}
            rows.append(row | {suite: _cell(results[policy]) for suite, results in groups.items()})
        sections.append(f"**{simulator}**\n\n{tables.markdown(rows)}")
    return "\n\n".join(sections)


def _cell(result: NavigationResult) -> str:
    row = navigation.summary(result)
    time = f", {row['seconds']:.1f} s" if row["successes"] else ""
    tilt = f"{math.degrees(row['abs_roll']):.1f} / {math.degrees(row['abs_pitch']):.1f} deg"
    return f"{row['successes']}/{row['tasks']}{time}, {tilt}"
