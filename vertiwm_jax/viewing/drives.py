"""A policy's drive through one task, and recorded drives with what a model predicts, as scenes."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from vertiwm_jax.config import ConfigError
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.env import suites
from vertiwm_jax.env.agent import Agent, Now, Policy
from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import TaskParams
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.evaluation import prediction
from vertiwm_jax.evaluation.prediction import Reading, TestWindows
from vertiwm_jax.evaluation.report import NavigationTest
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.dataset import Drives
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.models.registry import ModelName
from vertiwm_jax.rl import experiment
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.viewing.scene import Prediction, Scene

STEPS = 16
"""Of a prediction, and of the recorded drive that the model sees before it, as in the tables."""


def of_policy(
    run: Path, asked: NavigationTest, model: ModelName, weights: Path | None, task: int, seed: int
) -> Scene:
    """Drives the policy of a run on one of the tasks that are asked for.

    Args:
        run: the folder of the training.
        asked: which vehicle and worlds, if not those of the run.
        model: what the policy drives in.
        weights: folder of a fitted model, instead of the run's.
        task: which of the tasks there.
        seed: which of the policies that the run trained side by side.

    Raises:
        ConfigError: there is no such task or policy.
    """
    config = asked.changed(experiment.load(run / "config.yaml"))
    config = replace(config, weights=weights or config.weights)
    terrain = experiment.held_out(config)
    policies = experiment.learned(config, run)
    pool = suites.test_tasks(config.ground, terrain)
    for name, found, count in (("task", task, len(pool.world)), ("seed", seed, len(policies))):
        if not 0 <= found < count:
            raise ConfigError(f"{run}: {name}: expected 0 to {count - 1}, found {found}")
    alone = jax.tree.map(lambda x: x[task : task + 1], pool)
    env, params = experiment.environment(config, model, terrain, alone)
    name, policy = list(policies.items())[seed]
    return drive(env, params, policy, config.key("testing"), f"{name} in {model}")


def drive(
    env: NavigationEnv, task: TaskParams, agent: Policy | Agent, key: jax.Array, name: str
) -> Scene:
    """Drives the first task of the pool to its end; `name` is that of the agent, for the title."""

    def shown(agent: Agent, now: Now) -> tuple:
        """Keeps the state, the command that led there, and what the model tells of itself."""
        state = now.state
        command = now.task.vehicle.command(state.action, env.config.speed_range).vector
        return state.vehicle.vector, command, Reading.of(state.history)

    found = jax.tree.map(lambda x: np.asarray(x)[0], run_episodes(env, task, agent, key, shown))
    steps = int(found.steps)
    state, command, read = jax.tree.map(lambda x: x[: steps + 1], found.kept)
    ending = TerminationReason(int(found.ending)).name.lower().replace("_", " ")
    return Scene(
        title=f"{name}: {ending}, {STEP_SECONDS * steps:.1f} s",
        terrain=task.terrain.select(found.world),
        state=state,
        command=command[1:],
        wheels=read.wheels,
        coefficients=read.coefficients,
        goal=found.goal,
        goal_radius=env.config.goal_radius,
        vehicle=jax.device_get(task.vehicle),
    )


def recorded(path: Path, drive: int, name: str, dynamics: Dynamics, params: Params) -> Scene:
    """Loads a recorded drive, and predicts it every 16 steps.

    Args:
        path: a file of drives.
        drive: number of the drive in the file.
        name: what the model is called, for the title.
        dynamics, params: the model.

    Raises:
        DataError, MapError: the file cannot be used, or has no such drive of 32 steps or more.
    """
    drives, terrain = dataset.load_file(path)
    count, named = len(drives.length), f"{path}: drive"
    if not 0 <= drive < count:
        raise DataError(f"{named}: expected 0 to {count - 1}, found {drive}")
    length = int(drives.length[drive])
    if length < 2 * STEPS:
        raise DataError(f"{named} {drive}: expected at least {2 * STEPS} steps, found {length}")
    alone: Drives = jax.tree.map(lambda x: np.asarray(x)[drive : drive + 1], drives)
    test = TestWindows.of(alone, terrain, STEPS, STEPS, STEPS)
    states, read = prediction.predict(dynamics, params, test)
    first = np.asarray(test.windows.state)[:, STEPS]
    return Scene(
        title=f"{path.stem}, drive {drive}, and {name}",
        terrain=terrain,
        state=np.asarray(alone.state)[0, : length + 1],
        command=np.asarray(alone.control)[0, :length],
        wheels=jax.tree.map(lambda x: x[0, : length + 1], alone.wheels),
        prediction=Prediction(
            start=STEPS * (1 + np.arange(len(first))),
            state=np.concatenate([first[:, None], states.vector], axis=1),
            coefficients=read.coefficients,
            sinkage=read.wheels and np.asarray(read.wheels.wheel_sinkage),
        ),
    )
