"""Episodes of a policy in a simulator outside jit: the same task, with one vehicle a process."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.env import episodes
from vertiwm_jax.env.agent import Agent, Policy, as_agent
from vertiwm_jax.env.episodes import NavigationResult
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.suites import Tasks
from vertiwm_jax.env.task import TaskParams
from vertiwm_jax.models.registry import ModelName
from vertiwm_jax.rl.experiment import TaskConfig
from vertiwm_jax.runs import Progress
from vertiwm_jax.simulators import chrono
from vertiwm_jax.simulators.following import AgentPilot, Followed
from vertiwm_jax.simulators.processes import Map
from vertiwm_jax.simulators.protocol import Simulator, drive
from vertiwm_jax.terrain.map import TerrainMap

Arena = ModelName | Literal["chrono"]
"""What moves the vehicle in a test of policies."""


def expect(arena: Arena, config: TaskConfig) -> None:
    """Raises `SimulatorError` or `ConfigError` where no test with these settings is possible."""
    if arena == "chrono":
        chrono.expect(config.driven)


def evaluate(
    simulator: Callable[[TerrainMap], Simulator],
    mapped: Map,
    tasks: Tasks,
    env: NavigationEnv,
    params: TaskParams,
    agent: Policy | Agent,
    key: jax.Array,
) -> NavigationResult:
    """Drives every task of the pool once, as `run_episodes`, in a simulator outside jit.

    Args:
        simulator: makes one for a world.
        mapped: of `processes.simulating`.
        tasks: those of which `params` has the starts.
        env, params, agent, key: as of `run_episodes`.

    Returns:
        P episodes.
    """
    env, agent = replace(env, dynamics=Followed()), as_agent(agent)
    own = jax.vmap(partial(jax.random.fold_in, key))(jnp.arange(params.pool_size))
    shared = jax.device_get((tasks, params, agent, jax.random.key_data(own)))
    one, driven = partial(_drive, simulator, env, shared), []
    with Progress(params.pool_size, "episodes") as progress:
        for episode in mapped(one, range(params.pool_size)):
            driven.append(episode)
            progress.advance()
    return jax.tree.map(lambda *x: jnp.concatenate(x), *driven)


def _drive(
    simulator: Callable[[TerrainMap], Simulator], env: NavigationEnv, shared: tuple, number: int
) -> NavigationResult:
    """Drives one task. Arrays come from and go to host memory, as they pass between processes."""
    tasks, params, agent, keys = shared
    asked = jax.tree.map(lambda x: x[number], tasks)
    _, start = env.start(params, jnp.int32(number))
    params, agent, start = jax.device_put((params, agent, start))
    key = jax.random.wrap_key_data(jnp.asarray(keys[number]))
    pilot = AgentPilot(env, params, agent, start, key)
    pose, length = (*asked.start.tolist(), float(asked.yaw)), int(params.max_steps_in_episode)
    drive(simulator(params.terrain.select(asked.world)), pose, pilot, length + 1)
    poses = np.stack(pilot.path)
    filled = jnp.asarray(np.pad(poses, [(0, length + 1 - len(poses)), (0, 0)], "edge"))[:, None]
    end = jax.tree.map(lambda x: jnp.asarray(x)[None], pilot.state)
    return jax.device_get(episodes.result(end, filled[..., :3], filled[..., 3:]))
