"""A policy's drive through one task as a scene."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from vertiwm_jax.config import ConfigError
from vertiwm_jax.env import suites
from vertiwm_jax.env.agent import Agent, Policy
from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.suites import Suite
from vertiwm_jax.env.task import TaskParams, TaskState
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.evaluation.prediction import modeled_wheels
from vertiwm_jax.evaluation.report import NavigationTest
from vertiwm_jax.models.registry import ModelName
from vertiwm_jax.rl import experiment
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.viewing.scene import Scene


def load(
    run: Path,
    model: ModelName = "vertiwm",
    weights: Path | None = None,
    vehicle: str | None = None,
    suite: Suite | None = None,
    task: int = 0,
    seed: int = 0,
) -> Scene:
    """Drives the policy of a run on a task that was held out of its training.

    Args:
        run: the folder of the training.
        model: what the policy drives in.
        weights: folder of a fitted model, instead of the run's.
        vehicle: name or YAML file of a vehicle, instead of the run's.
        suite: kind of procedural worlds, instead of those held out.
        task: which of the tasks there.
        seed: which of the policies that the run trained side by side.

    Raises:
        ConfigError: there is no such task or policy.
    """
    asked = NavigationTest(run, vehicle=vehicle, suites=(suite,) if suite else (), planning=False)
    config = asked.changed(experiment.load(run / "config.yaml"))
    config = replace(config, weights=weights or config.weights)
    terrain = experiment.held_out(config)
    policies = experiment.learned(config, run)
    pool = suites.test_tasks(config.ground, terrain)
    for name, found, count in (("task", task, len(pool.world)), ("seed", seed, len(policies))):
        if not 0 <= found < count:
            raise ConfigError(f"{run}: {name}: expected 0 to {count - 1}, found {found}")
    alone = jax.tree.map(lambda x: x[task : task + 1], pool)
    test = experiment.environment(config, model, terrain, alone)
    name, policy = list(policies.items())[seed]
    title = f"{name} in {model}"
    scene = drive(test.env, test.params, policy, config.key("testing"), title)
    return replace(scene, vehicle=config.driven.vehicle)


def drive(
    env: NavigationEnv, task: TaskParams, agent: Policy | Agent, key: jax.Array, name: str
) -> Scene:
    """Drives the first task of the pool to its end; `name` is that of the agent, for the title."""

    def shown(task: TaskParams, state: TaskState) -> tuple:
        """Keeps the state, the command that led there, wheels and coefficients."""
        command = task.vehicle.command(state.action, env.config.speed_range).vector
        alpha = getattr(state.history, "coefficients", None)
        return state.vehicle.vector, command, modeled_wheels(state.history), alpha

    found = jax.tree.map(lambda x: np.asarray(x)[0], run_episodes(env, task, agent, key, shown))
    steps = int(found.steps)
    vehicle, command, wheels, alpha = jax.tree.map(lambda x: x[: steps + 1], found.kept)
    ending = TerminationReason(int(found.ending)).name.lower().replace("_", " ")
    return Scene(
        title=f"{name}: {ending}, {STEP_SECONDS * steps:.1f} s",
        terrain=task.terrain.select(found.world),
        state=vehicle,
        command=command[1:],
        wheels=wheels,
        coefficients=alpha,
        goal=found.goal,
        goal_radius=env.config.goal_radius,
    )
