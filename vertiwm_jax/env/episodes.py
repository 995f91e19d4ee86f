"""Whole episodes of an agent, and what comes of them."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax import machine, parallel
from vertiwm_jax.env.agent import Agent, Memory, Now, Policy, as_agent
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import TaskParams, TaskState
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.state import STEP_SECONDS

Keep = Callable[[Agent, Now], Any]
"""What is kept of an agent and each moment of its episode."""
Episode = tuple[Memory, jax.Array, TaskState]
"""An agent's memory, the observation, and where the episode stands; or leaves `[P, ...]` of P."""


@struct.dataclass
class NavigationResult:
    """P episodes, one for each task of the pool.

    ending: `[P]` int32 `TerminationReason` codes.
    steps: `[P]` int32, of 0.1 s.
    abs_roll, abs_pitch: `[P]` rad, mean over the steps of an episode.
    driven: `[P]` m along the path.
    final_distance: `[P]` m left to the goal.
    world: `[P]` int32; goal: `[P, 3]` m.
    position, rpy: `[P, T + 1, 3]` m and rad, from the start on; after the end, the last ones.
    kept: leaves `[P, T + 1, ...]`, what was asked for of each state.
    """

    ending: jax.Array
    steps: jax.Array
    abs_roll: jax.Array
    abs_pitch: jax.Array
    driven: jax.Array
    final_distance: jax.Array
    world: jax.Array
    goal: jax.Array
    position: jax.Array
    rpy: jax.Array
    kept: Any = None

    @property
    def success(self) -> jax.Array:
        """`[P]` whether the goal was reached."""
        return self.ending == TerminationReason.GOAL

    @property
    def seconds(self) -> jax.Array:
        """`[P]` duration, s."""
        return self.steps * STEP_SECONDS

    def path(self, episode: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions and roll, pitch, yaw of one episode, `[steps + 1, 3]` each."""
        end = int(self.steps[episode]) + 1
        return np.asarray(self.position[episode, :end]), np.asarray(self.rpy[episode, :end])


def run_episodes(
    env: NavigationEnv,
    task: TaskParams,
    agent: Policy | Agent,
    key: jax.Array,
    keep: Keep | None = None,
) -> NavigationResult:
    """Drives every task of the pool once, all at the same time, as one compiled program.

    Nothing is computed any more once the last episode has ended.

    Args:
        env: the environment.
        task: what it is run with.
        agent: what drives.
        key: of all that is random.
        keep: gives what is kept of each moment besides the pose.

    Returns:
        P episodes.
    """
    program = partial(_run, env, keep, int(task.max_steps_in_episode))
    return parallel.shared_out(program, task.pool_size)(task, as_agent(agent), key)


def result(
    end: TaskState, position: jax.Array, rpy: jax.Array, kept: Any = None
) -> NavigationResult:
    """What comes of P episodes that ended in states with leaves `[P, ...]`.

    position, rpy, kept: leaves `[T + 1, P, ...]`, after the end of an episode the last ones.
    """
    steps, length = jnp.asarray(end.time), len(position) - 1
    # Row 0 is the start, which no step led to.
    counted = (jnp.arange(length)[:, None] < steps)[..., None]
    mean_tilt = jnp.sum(jnp.abs(rpy[1:]) * counted, axis=0) / jnp.maximum(steps, 1)[:, None]
    return NavigationResult(
        ending=end.ending,
        steps=steps,
        abs_roll=mean_tilt[:, 0],
        abs_pitch=mean_tilt[:, 1],
        driven=jnp.sum(jnp.linalg.norm(jnp.diff(position, axis=0), axis=-1), axis=0),
        final_distance=jnp.linalg.norm(end.goal - end.vehicle.position, axis=-1),
        world=end.world,
        goal=end.goal,
        position=jnp.swapaxes(position, 0, 1),
        rpy=jnp.swapaxes(rpy, 0, 1),
        kept=jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), kept),
    )


@partial(jax.jit, static_argnames=("env", "keep", "length"))
def _run(
    env: NavigationEnv,
    keep: Keep | None,
    length: int,
    task: TaskParams,
    agent: Agent,
    key: jax.Array,
) -> NavigationResult:
    count, interval = task.pool_size, agent.interval
    planning = jax.random.fold_in(key, length)

    @partial(parallel.vmap, in_axes=(None, None, 0))
    def begin(agent: Agent, task: TaskParams, number: jax.Array) -> Episode:
        observation, state = env.start(task, number)
        return agent.init(Now(task, state, observation)), observation, state

    @partial(parallel.vmap, in_axes=(None, None, 0))
    def kept(agent: Agent, task: TaskParams, episode: Episode) -> tuple[jax.Array, jax.Array, Any]:
        _, observation, state = episode
        more = keep(agent, Now(task, state, observation)) if keep else None
        return state.vehicle.position, state.vehicle.rpy, more

    @partial(parallel.vmap, in_axes=(None, None, 0, 0))
    def drive(agent: Agent, task: TaskParams, episode: Episode, key: jax.Array) -> Episode:
        memory, observation, state = episode
        key_agent, key_step = jax.random.split(key)
        action, memory = agent.act(Now(task, state, observation), memory, key_agent)
        observation, state, *_ = env.step_env(key_step, state, action, task)
        return memory, observation, state

    def advance(episodes: Episode, step: jax.Array) -> tuple[Episode, tuple]:
        keys = jax.random.split(jax.random.fold_in(key, step), count)
        episodes = drive(agent, task, episodes, keys)
        return episodes, kept(agent, task, episodes)

    def drive_on(episodes: Episode, step: jax.Array) -> tuple[Episode, tuple]:
        keys = jax.random.split(jax.random.fold_in(planning, step), count)
        episodes = _plan(agent, task, episodes, keys)
        return jax.lax.scan(advance, episodes, step + jnp.arange(interval))

    def stay(episodes: Episode, step: jax.Array) -> tuple[Episode, tuple]:
        last = kept(agent, task, episodes)
        return episodes, jax.tree.map(lambda x: jnp.broadcast_to(x, (interval, *x.shape)), last)

    def decide(episodes: Episode, step: jax.Array) -> tuple[Episode, tuple]:
        running = jnp.any(episodes[2].ending == TerminationReason.RUNNING)
        return jax.lax.cond(running, drive_on, stay, episodes, step)

    first = begin(agent, task, jnp.arange(count))
    # Not a `while_loop`: on CPUs XLA runs what is inside one several times slower. Steps after the
    # time limit, to fill an interval, change nothing: all episodes are over.
    (_, _, end), paths = jax.lax.scan(decide, first, jnp.arange(0, length, interval))

    def joined(start: jax.Array, path: jax.Array) -> jax.Array:
        path = path.reshape(-1, *path.shape[2:])
        return jnp.concatenate([start[None], path[:length]])

    return result(end, *jax.tree.map(joined, kept(agent, task, first), paths))


def _plan(agent: Agent, task: TaskParams, episodes: Episode, keys: jax.Array) -> Episode:
    """Episodes, leaves `[P, ...]`, whose memories have plans where they still drive.

    Planners imagine many futures of each vehicle, so that a few at a time fill the devices, and
    none are imagined once a task is over.
    """
    if type(agent).plan is Agent.plan:
        return episodes
    memory, observation, state = episodes
    running = state.ending == TerminationReason.RUNNING
    of_device = machine.together(cpu=8, accelerator=128)
    together = min(of_device * parallel.number(), len(running))
    turns = -(-len(running) // together)
    # Those that drive come first, and the last turn is filled up with one that likely does not.
    filled = np.minimum(np.arange(turns * together), len(running) - 1)
    rows = jnp.argsort(~running)[filled].reshape(turns, together)

    @partial(parallel.vmap, in_axes=(None, None, 0, 0))
    def plan(agent: Agent, task: TaskParams, episode: Episode, key: jax.Array) -> Memory:
        memory, observation, state = episode
        return agent.plan(Now(task, state, observation), memory, key)

    def turn(rows: jax.Array) -> Memory:
        some, own = jax.tree.map(lambda x: x[rows], (episodes, keys))
        return jax.lax.cond(
            jnp.any(running[rows]),
            lambda some: plan(agent, task, some, own),
            lambda some: some[0],
            some,
        )

    planned = jax.lax.map(turn, rows)
    memory = jax.tree.map(lambda x, y: x.at[rows].set(y, mode="promise_in_bounds"), memory, planned)
    return memory, observation, state
