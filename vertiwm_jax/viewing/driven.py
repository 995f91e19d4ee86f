"""A policy's drive through one task as a scene."""

import jax
import numpy as np

from vertiwm_jax.env.agent import Agent, Policy
from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import TaskParams, TaskState
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.evaluation.prediction import modelled
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.viewing.scene import Scene


def drive(
    env: NavigationEnv, task: TaskParams, agent: Policy | Agent, key: jax.Array, name: str
) -> Scene:
    """Drives the first task of the pool to its end; `name` is that of the agent, for the title."""

    def shown(task: TaskParams, state: TaskState) -> tuple:
        """The state, the command that led there, wheels and coefficients."""
        command = task.vehicle.command(state.action, env.config.speed_range).vector
        alpha = getattr(state.history, "coefficients", None)
        return state.vehicle.vector, command, modelled(state.history), alpha

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
