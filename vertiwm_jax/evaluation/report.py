"""The test of policies: its settings, its tables by suite, all episodes, and pictures."""

import json
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast

import jax
import numpy as np

from vertiwm_jax import config as configuration
from vertiwm_jax import figures, machine, runs
from vertiwm_jax.config import ConfigError, Count, CountOrZero, NotNegative, Share, settings
from vertiwm_jax.env.agent import Agent, Now, Policy
from vertiwm_jax.env.controllers import REFERENCE
from vertiwm_jax.env.episodes import NavigationResult, run_episodes
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.suites import SMALLEST, Suite, test_tasks
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.evaluation import external, navigation, plots, tables
from vertiwm_jax.planning.improvement import ImprovementConfig
from vertiwm_jax.planning.mppi import MPPI, MPPIConfig
from vertiwm_jax.planning.shooting import Shooting, ShootingConfig
from vertiwm_jax.rl import experiment
from vertiwm_jax.rl.experiment import TaskConfig, TrainConfig
from vertiwm_jax.rl.policy import DeterministicPolicy
from vertiwm_jax.simulators import processes
from vertiwm_jax.simulators.chrono import Chrono
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import TerrainMap

Results = Mapping[str, NavigationResult]
"""Episodes, by policy."""

CURVES = {
    "episode_return": "return",
    "success": "success",
    "episode_length": "episode [actions]",
    "entropy": "entropy [nats]",
    "value_loss": "value loss",
    "kl": "KL divergence",
    "explained_variance": "explained variance",
}
"""What is drawn of a training, where it has that."""
GIVEN_MAPS = "given maps"
_log = logging.getLogger(__name__)


@settings
class NavigationTest:
    """Success, time, roll and pitch of a policy, on worlds that it was not trained on.

    The worlds and tasks are those held out of the policy's training, unless others are asked for.
    """

    policy: Literal["straight", "random", "mppi", "shooting"] | Path
    """Folder of a training run, or what has learned nothing: a controller, or a plan in a model."""
    mppi: MPPIConfig = MPPIConfig()
    """How it plans, and in which model, whatever moves the vehicle."""
    shooting: ShootingConfig = ShootingConfig()
    """The same of planning by gradients."""
    planning: bool | None = None
    """Whether the policy of a run drives a second time, planning; by default as its run says."""
    simulator: external.Arena = "builtin"
    """What moves the vehicle; Chrono needs PyChrono, and moves one in each process."""
    jobs: Count = 1
    """Processes that drive, in Chrono."""
    vehicle: str | None = None
    """Name or YAML file of another vehicle than the policy's training was meant for."""
    terrain: Path | None = None
    """A Verti-Bench checkout or a folder of .npz maps, to drive on all of them."""
    obstacles: bool = False
    """Whether the rocks and trees of these maps stand there."""
    suites: tuple[Suite, ...] = ()
    """Kinds of procedural worlds; all three by default."""
    suite_worlds: Count | None = None
    """How many worlds of each suite; as many as after training by default."""
    pairs: Count | None = None
    """Tasks in a world; as many as after training by default."""
    seed: CountOrZero | None = None
    """Draws other procedural worlds than those held out."""
    sensing_range: float | None = None
    """Range of sensors, m, inf to know all of the map; by default as in training."""
    missing: Share | None = None
    """Share of cells that are missing on the map; by default as in training."""
    height_noise: NotNegative | None = None
    """Standard deviation, m, of errors of the map's heights; by default as in training."""
    displaced: NotNegative | None = None
    """Distance, m, by which the map lies beside the ground; by default as in training."""
    output: Path | None = None
    """Folder for tables, all episodes and pictures."""

    def check(self):
        drawn = ("suites", "suite_worlds", "seed")
        found = [name for name in drawn if getattr(self, name) not in ((), None)]
        if self.terrain and found:
            raise ValueError(f"{found[0]}: is of procedural worlds, give it or terrain")
        if self.obstacles and not self.terrain:
            raise ValueError("obstacles: is of given worlds; procedural ones are a suite")
        if self.planning is not None and not isinstance(self.policy, Path):
            raise ValueError(f"planning: is of the policy of a run, found {self.policy}")
        if self.jobs > 1 and self.simulator != "chrono":
            raise ValueError(f"jobs: expected 1 in all simulators but Chrono, found {self.jobs}")

    def run(self) -> str:
        """Runs the test and writes what `output` asks for; returns the tables as Markdown."""
        run = self.policy if isinstance(self.policy, Path) else None
        if run and not run.is_dir():
            known = configuration.choices(str(run), ("straight", "random", "mppi", "shooting"))
            raise ConfigError(f"policy: expected the folder of a run or {known}, found {run}")
        file = run / "config.yaml" if run else configuration.default_config("ppo")
        trained = experiment.load(file)
        config = self.changed(trained)
        external.expect(self.simulator, config)
        policies = dict(config.baselines)
        if run:
            # It plans as it was trained, also where it knows less of the map.
            own = replace(config, navigation=trained.navigation)
            policies = experiment.learned(own, run) | policies
        elif self.policy == "straight":
            policies = {REFERENCE: policies[REFERENCE]}
        elif self.policy != "random":
            policies = {str(self.policy): self._planner(config)} | policies
        if self.terrain:
            scale = config.driven.scale
            terrain = files.load_map(
                self.terrain, scale=scale, obstacles=self.obstacles, least=SMALLEST
            )
        else:
            terrain = experiment.held_out(config)
        groups = drive(config, terrain, policies, config.world_suites, self.simulator, self.jobs)
        if self.output:
            write(self.output, groups, terrain, config.navigation.goal_radius)
        return markdown(groups)

    def changed(self, config: TrainConfig) -> TrainConfig:
        """The settings of a training with the test that is asked for."""
        asked = {name: getattr(self, name) for name in ("suites", "suite_worlds", "pairs")}
        ground = {name: value for name, value in asked.items() if value}
        asked = {name: getattr(self, name) for name in ("terrain", "vehicle", "seed")}
        changes = {name: value for name, value in asked.items() if value is not None}
        if self.suites or self.seed is not None:
            changes["terrain"] = None
        sensing = config.navigation.sensing
        asked = {
            "range": self.sensing_range,
            "missing": self.missing,
            "height_noise": self.height_noise,
            "displaced": self.displaced,
        }
        sensing = replace(sensing, **{k: v for k, v in asked.items() if v is not None})
        if sensing != config.navigation.sensing:
            changes["navigation"] = replace(config.navigation, sensing=sensing)
        if self.planning is not None:
            own = config.planning or ImprovementConfig()
            changes["planning"] = own if self.planning else None
        return replace(config, ground=replace(config.ground, **ground), **changes)

    def _planner(self, config: TrainConfig) -> Agent:
        by_gradients = self.policy == "shooting"
        kind, settings = Shooting if by_gradients else MPPI, getattr(self, str(self.policy))
        dynamics, weights = experiment.dynamics(config, settings.model, by_gradients)
        return kind(NavigationEnv(dynamics, config.navigation), weights, settings)


def after_training(config: TrainConfig, folder: Path, held_out: TerrainMap) -> str:
    """Tests what a training has learned, beside controllers, on the worlds held out.

    Writes tables and pictures into the folder of the run, also of how it learned. Returns the
    tables as Markdown.
    """
    columns = runs.read_columns(folder)
    labels = {name: label for name, label in CURVES.items() if name in columns}
    figure = plots.learning_curves({config.name: columns}, "timesteps", labels)
    figures.save(figure, folder / "learning_curves.png")
    machine.forget_programs()  # Tests need the memory.
    policies = experiment.learned(config, folder) | config.baselines
    groups = drive(config, held_out, policies, config.world_suites)
    write(folder, groups, held_out, config.navigation.goal_radius)
    return markdown(groups)


def drive(
    config: TaskConfig,
    terrain: TerrainMap,
    policies: Mapping[str, Policy | Agent],
    suites: Sequence[str] | None,
    simulator: external.Arena = "builtin",
    jobs: int = 1,
) -> dict[str, Results]:
    """Drives all tasks of a test with each policy.

    Args:
        config: what the task is, and how many tasks a world has.
        terrain: the worlds.
        policies: what drives, by name.
        suites: that of each world; None where the worlds are a user's own maps.
        simulator: what moves the vehicle.
        jobs: processes that drive, in Chrono.

    Returns:
        The episodes, by suite and policy.
    """
    model = "builtin" if simulator == "chrono" else simulator
    tasks, key = test_tasks(config.ground, terrain), config.key("testing")
    env, task = experiment.environment(config, model, terrain, tasks)
    _log.info("driving %d tasks on %d worlds ...", task.pool_size, terrain.worlds)
    results = {}
    chrono = partial(Chrono, driven=config.driven)
    with processes.simulating(jobs) as mapped:
        for name, policy in policies.items():
            start = time.perf_counter()
            inputs = env, task, policy, key
            if simulator == "chrono":
                results[name] = external.evaluate(chrono, mapped, tasks, *inputs)
            else:
                foretells = isinstance(policy, DeterministicPolicy) and policy.risk is not None
                results[name] = run_episodes(*inputs, _risk if foretells else None)
            solved, seconds = int(np.sum(results[name].success)), time.perf_counter() - start
            _log.info("  %s: %d solved, compiled and driven in %.0f s", name, solved, seconds)
    return by_suite(results, suites or [GIVEN_MAPS] * terrain.worlds)


def _risk(agent: Agent, now: Now) -> jax.Array:
    """`[]` of a policy that foretells it."""
    return cast(Any, agent).policy.risk(now.observation)


def by_suite(results: Results, suites: Sequence[str]) -> dict[str, Results]:
    """Splits the episodes of each policy by the suite of their world, of `suites` `[W]`.

    They are in host memory then.
    """

    def part(result: NavigationResult, suite: str) -> NavigationResult:
        rows = np.array(suites)[np.asarray(result.world)] == suite
        return jax.tree.map(lambda x: np.asarray(x)[rows], result)

    return {
        suite: {policy: part(result, suite) for policy, result in results.items()}
        for suite in dict.fromkeys(suites)
    }


def write(
    folder: Path, groups: Mapping[str, Results], terrain: TerrainMap, goal_radius: float
) -> None:
    """`summary.md`, `summary.json`, `episodes.csv`, and a picture of a hard task of each suite."""
    drawn = {}
    for name, results in groups.items():
        # The first task that straight to goal fails, better one that the first policy solves.
        first = next(iter(results.values()))
        hard = int(np.argmax(2 * ~results[REFERENCE].success + first.success))
        paths = {policy: result.path(hard) for policy, result in results.items()}
        risks = {
            policy: result.kept[hard, : len(paths[policy][0])]
            for policy, result in results.items()
            if result.kept is not None
        }
        goal = np.asarray(first.goal[hard]), goal_radius
        figure = plots.trajectories(terrain, int(first.world[hard]), paths, *goal, risks)
        drawn[f"trajectories_{name}.png"] = figure
    texts = {
        "summary.md": markdown(groups) + "\n",
        "summary.json": json.dumps(summary(groups), indent=2) + "\n",
        "episodes.csv": tables.csv_text(_episodes(groups, terrain)),
    }
    tables.write(folder, texts | drawn)


def markdown(groups: Mapping[str, Results]) -> str:
    """A table for each suite, and how many tasks that straight to goal fails the others solve."""
    sections = []
    for suite, rows in summary(groups).items():
        section = f"**{suite}**\n\n{navigation.format_table(rows)}"
        solved = [
            f"{policy} {row['solved_of_reference_failures']}"
            for policy, row in rows.items()
            if policy != REFERENCE
        ]
        if solved:
            failures = rows[REFERENCE]["tasks"] - rows[REFERENCE]["successes"]
            section += f"\n\nSolved of the {failures} tasks that {REFERENCE} fails: "
            section += ", ".join(solved)
        sections.append(section)
    return "\n\n".join(sections)


def summary(groups: Mapping[str, Results]) -> dict[str, dict[str, dict[str, Any]]]:
    """The same as plain numbers, for JSON; what has no value is None."""
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for suite, results in groups.items():
        failed, found[suite] = ~results[REFERENCE].success, {}
        for policy, result in results.items():
            solved = {"solved_of_reference_failures": int(np.sum(result.success & failed))}
            found[suite][policy] = navigation.summary(result) | solved
    return found


def _episodes(groups: Mapping[str, Results], terrain: TerrainMap) -> list[tables.Row]:
    """A row for each episode, in the coordinates of the file of its map."""
    told = any(x.kept is not None for results in groups.values() for x in results.values())
    return [
        {
            "suite": suite,
            "policy": policy,
            "world": int(result.world[i]),
            "goal_x": float(result.goal[i, 0] + terrain.offset(result.world[i])[0]),
            "goal_y": float(result.goal[i, 1] + terrain.offset(result.world[i])[1]),
            "ending": TerminationReason(int(result.ending[i])).name.lower(),
            "seconds": round(float(result.seconds[i]), 1),
            "abs_roll_deg": math.degrees(float(result.abs_roll[i])),
            "abs_pitch_deg": math.degrees(float(result.abs_pitch[i])),
            "driven_m": float(result.driven[i]),
            "final_distance_m": float(result.final_distance[i]),
        }
        | ({"highest_risk": _highest(result, i)} if told else {})
        for suite, results in groups.items()
        for policy, result in results.items()
        for i in range(len(result.ending))
    ]


def _highest(result: NavigationResult, episode: int) -> float | str:
    """The highest risk of an episode, where a policy foretells it."""
    return "" if result.kept is None else float(result.kept[episode].max())
