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

Keep = Callable[[TaskParams, TaskState], Any]
"""What is kept of the parameters of a task and of each state of an episode."""


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
        keep: gives what is kept of each state besides its pose.

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
    count = task.pool_size
    observation, start = parallel.vmap(env.start, (None, 0))(task, jnp.arange(count))

    def init(agent: Agent, task: TaskParams, state: TaskState, observation: jax.Array) -> Memory:
        return agent.init(Now(task, state, observation))

    @partial(parallel.vmap, in_axes=(None, 0))
    def kept(task: TaskParams, state: TaskState) -> tuple:
        more = keep(task, state) if keep else None
        return state.vehicle.position, state.vehicle.rpy, more

    @partial(parallel.vmap, in_axes=(None, None, 0, 0, 0, 0))
    def drive(
        agent: Agent,
        task: TaskParams,
        memory: Memory,
        observation: jax.Array,
        state: TaskState,
        key: jax.Array,
    ) -> tuple[Memory, jax.Array, TaskState]:
        key_agent, key_step = jax.random.split(key)
        action, memory = agent.act(Now(task, state, observation), memory, key_agent)
        observation, state, *_ = env.step_env(key_step, state, action, task)
        return memory, observation, state

    def advance(carry: tuple, _: None) -> tuple[tuple, None]:
        step, memory, observation, state, paths = carry
        keys = jax.random.split(jax.random.fold_in(key, step), count)
        memory, observation, state = drive(agent, task, memory, observation, state, keys)
        step = step + 1
        paths = jax.tree.map(lambda path, x: path.at[step].set(x), paths, kept(task, state))
        return (step, memory, observation, state, paths), None

    def drive_on(carry: tuple) -> tuple:
        step, memory, observation, state, paths = carry
        keys = jax.random.split(jax.random.fold_in(planning, step), count)
        memory = _plan(agent, task, memory, observation, state, keys)
        carry = step, memory, observation, state, paths
        return jax.lax.scan(advance, carry, length=agent.interval)[0]

    def unless_over(carry: tuple, _: None) -> tuple[tuple, None]:
        running = jnp.any(carry[3].ending == TerminationReason.RUNNING)
        return jax.lax.cond(running, drive_on, lambda over: over, carry), None

    # Steps after the time limit, to fill an interval, change nothing: all episodes are over.
    planning = jax.random.fold_in(key, length)
    memory = parallel.vmap(init, (None, None, 0, 0))(agent, task, start, observation)
    paths = jax.tree.map(lambda x: jnp.broadcast_to(x, (length + 1, *x.shape)), kept(task, start))
    carry = jnp.int32(0), memory, observation, start, paths
    # Not a `while_loop`: on CPUs XLA runs what is inside one several times slower.
    decisions = -(-length // agent.interval)
    (last, _, _, end, paths), _ = jax.lax.scan(unless_over, carry, length=decisions)

    def filled(path: jax.Array, x: jax.Array) -> jax.Array:
        after = jnp.arange(length + 1) > last
        return jnp.where(jnp.expand_dims(after, range(1, path.ndim)), x, path)

    return result(end, *jax.tree.map(filled, paths, kept(task, end)))


def _plan(
    agent: Agent,
    task: TaskParams,
    memory: Memory,
    observation: jax.Array,
    state: TaskState,
    keys: jax.Array,
) -> Memory:
    """Memories, leaves `[P, ...]`, with plans of those that still drive.

    Planners imagine many futures of each vehicle, so that a few at a time fill the devices, and
    none are imagined once a task is over.
    """
    if type(agent).plan is Agent.plan:
        return memory
    running = state.ending == TerminationReason.RUNNING
    of_device = machine.together(cpu=8, accelerator=128)
    together = min(of_device * parallel.number(), len(running))
    turns = -(-len(running) // together)
    # Those that drive come first, and the last turn is filled up with one that likely does not.
    filled = np.minimum(np.arange(turns * together), len(running) - 1)
    rows = jnp.argsort(~running)[filled].reshape(turns, together)

    @partial(parallel.vmap, in_axes=(None, None, 0, 0, 0, 0))
    def plan(
        agent: Agent,
        task: TaskParams,
        memory: Memory,
        observation: jax.Array,
        state: TaskState,
        key: jax.Array,
    ) -> Memory:
        return agent.plan(Now(task, state, observation), memory, key)

    def turn(rows: jax.Array) -> Memory:
        of_some = jax.tree.map(lambda x: x[rows], (memory, observation, state, keys))
        return jax.lax.cond(
            jnp.any(running[rows]),
            lambda some: plan(agent, task, *some),
            lambda some: some[0],
            of_some,
        )

    planned = jax.lax.map(turn, rows)
    return jax.tree.map(lambda x, y: x.at[rows].set(y, mode="promise_in_bounds"), memory, planned)
