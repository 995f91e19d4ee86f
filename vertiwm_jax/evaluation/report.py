"""What a test of policies leaves behind: tables by suite, every episode, and pictures."""

import dataclasses
import json
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from vertiwm_jax import atomic, figures, machine, runs
from vertiwm_jax.env.agent import Agent, Policy
from vertiwm_jax.env.controllers import REFERENCE
from vertiwm_jax.env.episodes import NavigationResult, run_episodes
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import TaskParams
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.evaluation import plots
from vertiwm_jax.evaluation.navigation import Summary, format_table
from vertiwm_jax.evaluation.tables import csv_text
from vertiwm_jax.rl import experiment
from vertiwm_jax.rl.experiment import Trained
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain.map import TerrainMap

Results = Mapping[str, NavigationResult]
Judge = Callable[[NavigationEnv, TaskParams, Policy | Agent, jax.Array], NavigationResult]

CURVES = {
    "episode_return": "return",
    "success": "success",
    "episode_length": "episode [steps]",
    "entropy": "entropy [nats]",
    "value_loss": "value loss",
    "kl": "KL divergence",
    "explained_variance": "explained variance",
}
"""What is drawn of a training, where it has that."""
GIVEN_MAPS = "given maps"
_log = logging.getLogger(__name__)


def after_training(trained: Trained) -> str:
    """Tests what a training has learned, beside controllers, on the worlds held out.

    Leaves tables and pictures in the folder of the run, also of how it learned; the tables as text.
    """
    config, folder = trained.config, trained.folder
    columns = runs.read_columns(folder)
    labels = {name: label for name, label in CURVES.items() if name in columns}
    figure = plots.learning_curves({config.name: columns}, "timesteps", labels, "steps of 0.1 s")
    figures.save(figure, folder / "learning_curves.png")
    machine.forget_programs()  # Tests need the memory.
    test = experiment.test_environment(config, trained.held_out)
    policies = experiment.learned(config, folder) | config.baselines
    key = config.key("testing")
    groups = drive(test.env, test.params, policies, key, trained.world_suites)
    write(folder, groups, REFERENCE, test.params.terrain, config.navigation.goal_radius)
    return markdown(groups, REFERENCE)


def drive(
    env: NavigationEnv,
    params: TaskParams,
    policies: Mapping[str, Policy | Agent],
    key: jax.Array,
    suites: Sequence[str] | None = None,
    judge: Judge = run_episodes,
) -> dict[str, Results]:
    """Drives all tasks of the pool with each policy; the results by suite.

    suites: that of each world; None where the worlds are a user's own maps.
    """
    _log.info("driving %d tasks on %d worlds ...", params.pool_size, params.terrain.worlds)
    results = {}
    for name, policy in policies.items():
        start = time.perf_counter()
        results[name] = judge(env, params, policy, key)
        solved, seconds = int(np.sum(results[name].success)), time.perf_counter() - start
        _log.info("  %s: %d solved, compiled and driven in %.0f s", name, solved, seconds)
    return by_suite(results, suites or [GIVEN_MAPS] * params.terrain.worlds)


def by_suite(results: Results, suites: Sequence[str]) -> dict[str, Results]:
    """Splits the episodes of each policy by the suite of their world, of `suites` `[W]`."""
    groups = {}
    for name in dict.fromkeys(suites):
        worlds = [world for world, found in enumerate(suites) if found == name]
        groups[name] = {
            policy: jax.tree.map(lambda x, rows=np.isin(result.world, worlds): x[rows], result)
            for policy, result in results.items()
        }
    return groups


def write(
    folder: Path,
    groups: Mapping[str, Results],
    reference: str,
    terrain: TerrainMap,
    goal_radius: float,
) -> None:
    """`summary.md`, `summary.json`, `episodes.csv`, and a picture of a hard task of each suite."""
    folder.mkdir(parents=True, exist_ok=True)
    atomic.write(folder / "summary.md", markdown(groups, reference) + "\n")
    numbers = json.dumps(summary(groups, reference), indent=2)
    atomic.write(folder / "summary.json", numbers + "\n")
    atomic.write(folder / "episodes.csv", csv_text(_episodes(groups)))
    for name, results in groups.items():
        hard = _hard_task(results, reference)
        first = next(iter(results.values()))
        figure = plots.trajectories(
            terrain,
            int(first.world[hard]),
            {policy: result.path(hard) for policy, result in results.items()},
            np.asarray(first.goal[hard]),
            goal_radius,
            STEP_SECONDS,
        )
        figures.save(figure, folder / f"trajectories_{name.replace(', ', '_')}.png")


def markdown(groups: Mapping[str, Results], reference: str) -> str:
    """A table for each group, and how many tasks that `reference` fails the others solve."""
    return "\n\n".join(_section(name, results, reference) for name, results in groups.items())


def summary(groups: Mapping[str, Results], reference: str) -> dict[str, Any]:
    """The same as plain numbers, for JSON; what has no value is None."""
    return {
        name: {
            policy: {
                **_plain(Summary.of(result)),
                "solved_of_reference_failures": _rescued(result, results[reference]),
            }
            for policy, result in results.items()
        }
        for name, results in groups.items()
    }


def _episodes(groups: Mapping[str, Results]) -> list[dict[str, str | float]]:
    """One line for each episode."""
    return [
        {
            "suite": suite,
            "policy": policy,
            "world": int(result.world[i]),
            "goal_x": float(result.goal[i, 0]),
            "goal_y": float(result.goal[i, 1]),
            "ending": TerminationReason(int(result.ending[i])).name.lower(),
            "seconds": round(float(result.seconds[i]), 1),
            "abs_roll_deg": math.degrees(float(result.abs_roll[i])),
            "abs_pitch_deg": math.degrees(float(result.abs_pitch[i])),
            "driven_m": float(result.driven[i]),
            "final_distance_m": float(result.final_distance[i]),
        }
        for suite, results in groups.items()
        for policy, device in results.items()
        for result in [jax.device_get(device)]
        for i in range(len(result.ending))
    ]


def _hard_task(results: Results, reference: str) -> int:
    """The first task that the reference fails, better still one that the first policy solves."""
    failed = ~np.asarray(results[reference].success)
    solved = np.asarray(next(iter(results.values())).success)
    return int(np.argmax(2 * failed + solved))


def _plain(row: Summary) -> dict[str, Any]:
    values = dataclasses.asdict(row)
    return {name: None if value != value else value for name, value in values.items()}


def _section(name: str, results: Results, reference: str) -> str:
    table = format_table({policy: Summary.of(result) for policy, result in results.items()})
    others = [policy for policy in results if policy != reference]
    if not others:
        return f"**{name}**\n\n{table}"
    failures = int(np.sum(~np.asarray(results[reference].success)))
    rescued = ", ".join(
        f"{policy} {_rescued(results[policy], results[reference])}" for policy in others
    )
    return (
        f"**{name}**\n\n{table}\n\nSolved of the {failures} tasks that {reference} fails: {rescued}"
    )


def _rescued(result: NavigationResult, reference: NavigationResult) -> int:
    return int(np.sum(np.asarray(result.success) & ~np.asarray(reference.success)))
