"""Policies that are trained in several models and judged all alike."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vertiwm_jax import atomic
from vertiwm_jax import config as configuration
from vertiwm_jax.config import AtLeastOne, ConfigError, Count
from vertiwm_jax.env import suites
from vertiwm_jax.env.agent import Agent, Policy
from vertiwm_jax.env.controllers import REFERENCE
from vertiwm_jax.env.episodes import NavigationResult
from vertiwm_jax.env.suites import SUITES, GroundConfig, Suite
from vertiwm_jax.evaluation import external, policy_table, report
from vertiwm_jax.evaluation.external import Arena
from vertiwm_jax.evaluation.policy_table import TrainingCost
from vertiwm_jax.evaluation.report import Results
from vertiwm_jax.models.registry import ModelName
from vertiwm_jax.rl import experiment
from vertiwm_jax.rl.experiment import TRAININGS, TrainConfig
from vertiwm_jax.runs import Run
from vertiwm_jax.simulators import processes
from vertiwm_jax.simulators.processes import Map
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.training import keep_compiled

Policies = Mapping[str, Policy | Agent]
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
    """Train policies by several algorithms in several models, and judge them all alike."""

    rows: tyro.conf.Suppress[tyro.conf.Fixed[Annotated[tuple[Row, ...], AtLeastOne]]]
    """Which policies; in a file only."""
    simulators: Annotated[tuple[Arena, ...], AtLeastOne] = ("builtin",)
    """What they are judged in; Chrono needs PyChrono."""
    suites: tuple[Suite, ...] = tuple(SUITES)
    """Kinds of worlds that they are judged on."""
    suite_worlds: Count = 10
    """How many worlds of each."""
    pairs: Count = 10
    """Tasks in a world."""
    jobs: Count = 1
    """Processes that drive, in Chrono."""
    seed: int = 0
    """Draws the worlds; how policies are trained has seeds of its own."""
    settings: Path | None = None
    """Folder with `ppo.yaml`, `sac.yaml` and `td3.yaml`; those of the package by default."""
    name: str = "compare"
    """What the name of the run folder begins with; the date follows."""
    runs: Path = Path("runs")
    """Folder in which the folder of this run is made."""
    resume: Path | None = None
    """Folder of an earlier run to go on with; policies that are trained are not trained again."""
    compile_cache: Path | None = None
    """Folder that keeps compiled programs for later runs."""

    def check(self):
        if len(set(self.rows)) < len(self.rows):
            raise ValueError("rows: expected each of them once, found one again")

    @property
    def grounds(self) -> GroundConfig:
        """What is driven on."""
        return GroundConfig(suites=self.suites, suite_worlds=self.suite_worlds, pairs=self.pairs)


def compare(config: CompareConfig) -> str:
    """Trains what is not trained yet, and drives all policies; their table, which the run keeps."""
    keep_compiled(config.compile_cache)
    settings = {row: training(config, row) for row in config.rows}
    vehicles = {chosen.vehicle for chosen in settings.values()}
    if len(vehicles) > 1:
        names = " and ".join(sorted(vehicles))
        raise ConfigError(f"{config.settings}: vehicle: expected one for all, found {names}")
    for simulator in config.simulators:
        external.expect(simulator, settings[config.rows[0]])
    with Run.begin(config, config.name) as run:
        folders = {row: _train(row, settings[row], run.folder) for row in config.rows}
        return _judge_all(config, settings, folders, run.folder)


def training(config: CompareConfig, row: Row) -> TrainConfig:
    """How a policy is trained."""
    folder, kind = config.settings, TRAININGS[row.algorithm]
    file = folder / f"{kind.name}.yaml" if folder else configuration.default_config(kind.name)
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
        settings = replace(settings, operands=kept.operands)
    trained = experiment.run(replace(settings, runs=place, resume=begun))
    _log.info("\n%s\n", report.after_training(trained))
    return trained.folder


def _judge_all(
    config: CompareConfig, settings: dict[Row, TrainConfig], folders: dict[Row, Path], output: Path
) -> str:
    key = experiment.TaskConfig(seed=config.seed).key("worlds")
    first = settings[config.rows[0]]
    terrain = suites.suite_worlds(config.grounds, key, first.driven.scale)
    rows = [(settings[row], _learned(row, settings[row], folders[row])) for row in config.rows]
    rows.append((first, first.baselines))
    judged = {}
    for simulator in config.simulators:
        with processes.simulating(config.jobs) as mapped:
            judged[simulator] = _judge(config.grounds, rows, terrain, simulator, mapped)
        radius = first.navigation.goal_radius
        report.write(output / simulator, judged[simulator], REFERENCE, terrain, radius)
    costs = {str(row): TrainingCost.of(folder) for row, folder in folders.items()}
    table = policy_table.markdown(costs, judged)
    atomic.write(output / "table.md", table + "\n")
    return table


def _learned(row: Row, settings: TrainConfig, folder: Path) -> Policies:
    """The policies of a training, by their names in the table."""
    found = experiment.learned(settings, folder)
    return {name.replace(row.algorithm, str(row), 1): x for name, x in found.items()}


def _judge(
    grounds: GroundConfig,
    rows: Sequence[tuple[TrainConfig, Policies]],
    terrain: TerrainMap,
    simulator: Arena,
    mapped: Map,
) -> dict[str, Results]:
    """Episodes of every policy, by suite."""
    groups: dict[str, dict[str, NavigationResult]] = {}
    for settings, policies in rows:
        settings = replace(settings, ground=grounds)
        test = external.test_in(simulator, settings, terrain)
        judge = external.judge_in(simulator, settings, terrain, mapped)
        key = settings.key("testing")
        driven = report.drive(test.env, test.params, policies, key, grounds.world_suites, judge)
        for suite, results in driven.items():
            groups.setdefault(suite, {}).update(results)
    return dict(groups)
