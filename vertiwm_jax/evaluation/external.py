"""How well a policy drives in a simulator outside jit: the same task, a vehicle a process."""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.config import ConfigError
from vertiwm_jax.env import suites
from vertiwm_jax.env.agent import Agent, Memory, Policy, Reactive
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import TaskParams, TaskState
from vertiwm_jax.env.tasks import Tasks
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.evaluation import navigation
from vertiwm_jax.evaluation.navigation import NavigationResult
from vertiwm_jax.evaluation.report import Judge
from vertiwm_jax.mechanics.vehicle import HMMWV
from vertiwm_jax.rl import experiment
from vertiwm_jax.rl.experiment import Task, TaskConfig
from vertiwm_jax.runs import Progress
from vertiwm_jax.simulators import chrono, following
from vertiwm_jax.simulators.chrono import Chrono
from vertiwm_jax.simulators.processes import Map
from vertiwm_jax.simulators.protocol import Simulator
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model.choice import ModelName

Arena = ModelName | Literal["chrono"]
"""What moves a vehicle whose policy is judged."""


def expect(arena: Arena, config: TaskConfig) -> None:
    """`SimulatorError` or `ConfigError` where policies of these settings cannot be judged there."""
    if arena == "chrono":
        chrono.modules()
        if config.vehicle != HMMWV:
            raise ConfigError(f"vehicle: expected {HMMWV} in Chrono, found {config.vehicle}")


def test_in(arena: Arena, config: TaskConfig, terrain: TerrainMap) -> Task:
    """The test on these worlds."""
    return experiment.test_environment(config, terrain, "builtin" if arena == "chrono" else arena)


def judge_in(arena: Arena, config: TaskConfig, terrain: TerrainMap, mapped: Map) -> Judge:
    """What drives the tasks of `test_in`; mapped: as in `evaluate`, for Chrono."""
    if arena != "chrono":
        return navigation.evaluate
    return partial(evaluate, Chrono, mapped, suites.test_tasks(config.ground, terrain))


def evaluate(
    simulator: Callable[[TerrainMap], Simulator],
    mapped: Map,
    tasks: Tasks,
    env: NavigationEnv,
    params: TaskParams,
    policy: Policy | Agent,
    key: jax.Array,
) -> NavigationResult:
    """As `navigation.evaluate`, with the vehicle in `simulator` on the world of each task.

    mapped: of `processes.simulating`; tasks: of which `params` has the starts.
    """
    env = following.followed(env)
    driver = policy if isinstance(policy, Agent) else Reactive(policy)
    own = jax.vmap(partial(jax.random.fold_in, key))(jnp.arange(params.pool_size))
    shared = jax.device_get((tasks, params, driver, jax.random.key_data(own)))
    one, episodes = partial(_drive, simulator, env, *shared), []
    with Progress(params.pool_size, "episodes") as progress:
        for episode in mapped(one, range(params.pool_size)):
            episodes.append(episode)
            progress.advance()
    return jax.tree.map(lambda *x: jnp.stack(x), *episodes)


def _drive(
    simulator: Callable[[TerrainMap], Simulator],
    env: NavigationEnv,
    tasks: Tasks,
    params: TaskParams,
    driver: Agent,
    keys: np.ndarray,
    number: int,
) -> NavigationResult:
    """Task `number`; everything comes from and goes to host memory, as between processes."""
    asked, start = jax.tree.map(lambda x: x[number], (tasks, params.starts))
    params, driver, start = jax.device_put((params, driver, start))
    vehicle = simulator(params.terrain.select(asked.world))
    pose = (*asked.start.tolist(), float(asked.yaw))
    observation, state = following.start(vehicle, env, params, start, pose)
    key = jax.random.wrap_key_data(jnp.asarray(keys[number]))
    return jax.device_get(_episode(vehicle, env, params, driver, observation, state, key))


def _episode(
    simulator: Simulator,
    env: NavigationEnv,
    params: TaskParams,
    driver: Agent,
    observation: jax.Array,
    state: TaskState,
    key: jax.Array,
) -> NavigationResult:
    """One episode, leaves without the axis of tasks."""
    memory, length = driver.start(params, state), int(params.max_steps_in_episode)
    path = [np.concatenate([state.vehicle.position, state.vehicle.rpy])]
    while state.ending == TerminationReason.RUNNING:
        step = len(path) - 1
        deciding, acting = jax.random.split(jax.random.fold_in(key, step))
        if step % driver.interval == 0:
            memory = _decide(driver, params, memory, observation, state, deciding)
        action, memory = _act(driver, params, memory, observation, state, acting)
        moved = following.move(simulator, env, params, action)
        observation, state = _follow(env, moved, state, action, acting)
        path.append(np.concatenate([state.vehicle.position, state.vehicle.rpy]))
    poses = np.stack(path)
    tilt = np.abs(poses[1:, 3:5]).mean(axis=0)
    filled = np.pad(poses, [(0, length + 1 - len(poses)), (0, 0)], "edge")
    return NavigationResult(
        ending=state.ending,
        steps=jnp.asarray(state.time),
        abs_roll=jnp.asarray(tilt[0]),
        abs_pitch=jnp.asarray(tilt[1]),
        driven=jnp.asarray(np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=-1).sum()),
        final_distance=jnp.linalg.norm(state.goal - state.vehicle.position),
        world=state.world,
        goal=state.goal,
        position=jnp.asarray(filled[:, :3]),
        rpy=jnp.asarray(filled[:, 3:]),
    )


@jax.jit
def _decide(driver: Agent, params: TaskParams, memory: Memory, *rest: Any) -> Memory:
    return driver.decide(params, memory, *rest)


@jax.jit
def _act(driver: Agent, params: TaskParams, memory: Memory, *rest: Any) -> tuple[jax.Array, Memory]:
    return driver.act(params, memory, *rest)


@partial(jax.jit, static_argnames="env")
def _follow(
    env: NavigationEnv,
    params: TaskParams,
    state: TaskState,
    action: jax.Array,
    key: jax.Array,
) -> tuple[jax.Array, TaskState]:
    """Observation and state of the task after the vehicle has moved."""
    return env.step_env(key, state, action, params)[:2]
