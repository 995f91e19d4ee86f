"""A policy's drive through one task as a scene."""

from functools import partial

import jax
import numpy as np

from vertiwm_jax.env.agent import Agent, Memory, Policy, Reactive
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import TaskParams, TaskState
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.evaluation.prediction import modelled
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.viewing.scene import Scene


def drive(
    env: NavigationEnv,
    params: TaskParams,
    policy: Policy | Agent,
    key: jax.Array,
    name: str,
) -> Scene:
    """Drives the first task of the pool to its end; `name` is that of the policy, for the title."""
    driver = policy if isinstance(policy, Agent) else Reactive(policy)
    observation, state = env.start(params, jax.numpy.int32(0))
    memory = driver.start(params, state)
    rows = [_row(env, params, state)]
    for step in range(int(params.max_steps_in_episode)):
        if state.ending != TerminationReason.RUNNING:
            break
        keys = jax.random.split(jax.random.fold_in(key, step), 3)
        if step % driver.interval == 0:
            memory = _decide(driver, params, memory, observation, state, keys[0])
        memory, observation, state = _advance(
            env, driver, params, memory, observation, state, keys[1:]
        )
        rows.append(_row(env, params, state))
    vehicle, command, wheels, alpha = jax.tree.map(lambda *x: np.stack(x), *rows)
    ending = TerminationReason(int(state.ending)).name.lower().replace("_", " ")
    return Scene(
        title=f"{name}: {ending}, {STEP_SECONDS * int(state.time):.1f} s",
        terrain=params.terrain.select(state.world),
        state=vehicle,
        command=command[1:],
        wheels=wheels,
        coefficients=alpha,
        goal=np.asarray(state.goal),
        goal_radius=env.config.goal_radius,
    )


def _row(env: NavigationEnv, params: TaskParams, state: TaskState) -> tuple:
    """What is kept of a step: the state, the command that led there, wheels and coefficients."""
    command = params.vehicle.command(state.action, env.config.speed_range).vector
    alpha = getattr(state.history, "coefficients", None)
    return jax.device_get((state.vehicle.vector, command, modelled(state.history), alpha))


@jax.jit
def _decide(
    driver: Agent,
    params: TaskParams,
    memory: Memory,
    observation: jax.Array,
    state: TaskState,
    key: jax.Array,
) -> Memory:
    return driver.decide(params, memory, observation, state, key)


@partial(jax.jit, static_argnames="env")
def _advance(
    env: NavigationEnv,
    driver: Agent,
    params: TaskParams,
    memory: Memory,
    observation: jax.Array,
    state: TaskState,
    keys: jax.Array,
) -> tuple[Memory, jax.Array, TaskState]:
    action, memory = driver.act(params, memory, observation, state, keys[0])
    observation, state, *_ = env.step_env(keys[1], state, action, params)
    return memory, observation, state
