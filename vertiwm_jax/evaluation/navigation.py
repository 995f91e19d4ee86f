"""How well a policy drives: success, time, roll and pitch over a set of tasks."""

import dataclasses
import math
from collections.abc import Mapping
from functools import partial
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax import parallel
from vertiwm_jax.env.agent import Agent, Policy, Reactive
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import TaskParams, TaskState
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.state import STEP_SECONDS

_TOGETHER = 8  # vehicles that a device decides for at a time


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


def evaluate(
    env: NavigationEnv, params: TaskParams, policy: Policy | Agent, key: jax.Array
) -> NavigationResult:
    """Drives every task of the pool once, all at the same time, as one compiled program.

    Nothing is computed any more once the last episode has ended.
    """
    driver = policy if isinstance(policy, Agent) else Reactive(policy)
    program = partial(_evaluate, env, int(params.max_steps_in_episode))
    return parallel.shared_out(program, params.pool_size)(params, driver, key)


@partial(jax.jit, static_argnames=("env", "length"))
def _evaluate(
    env: NavigationEnv, length: int, params: TaskParams, driver: Agent, key: jax.Array
) -> NavigationResult:
    count = params.pool_size
    observation, start = parallel.vmap(env.start, (None, 0))(params, jnp.arange(count))

    def position_and_rpy(state: TaskState) -> tuple[jax.Array, jax.Array]:
        return state.vehicle.position, state.vehicle.rpy

    paths = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (length + 1, *x.shape)), position_and_rpy(start)
    )

    @partial(parallel.vmap, in_axes=(None, None, 0, 0, 0, 0))
    def drive(
        driver: Agent,
        params: TaskParams,
        memory: Any,
        observation: jax.Array,
        state: TaskState,
        key: jax.Array,
    ) -> tuple[Any, jax.Array, TaskState]:
        key_policy, key_step = jax.random.split(key)
        action, memory = driver.act(params, memory, observation, state, key_policy)
        observation, state, *_ = env.step_env(key_step, state, action, params)
        return memory, observation, state

    def advance(carry: tuple, _: None) -> tuple[tuple, None]:
        step, memory, observation, state, paths = carry
        keys = jax.random.split(jax.random.fold_in(key, step), count)
        memory, observation, state = drive(driver, params, memory, observation, state, keys)
        step = step + 1
        paths = jax.tree.map(lambda path, x: path.at[step].set(x), paths, position_and_rpy(state))
        return (step, memory, observation, state, paths), None

    def drive_on(carry: tuple) -> tuple:
        step, memory, observation, state, paths = carry
        keys = jax.random.split(jax.random.fold_in(deciding, step), count)
        memory = _decide(driver, params, memory, observation, state, keys)
        carry = step, memory, observation, state, paths
        return jax.lax.scan(advance, carry, length=driver.interval)[0]

    def unless_over(carry: tuple, _: None) -> tuple[tuple, None]:
        running = jnp.any(carry[3].ending == TerminationReason.RUNNING)
        return jax.lax.cond(running, drive_on, lambda over: over, carry), None

    # Steps after the time limit, to fill an interval, change nothing: all episodes are over.
    deciding = jax.random.fold_in(key, length)
    memory = parallel.vmap(type(driver).start, (None, None, 0))(driver, params, start)
    carry = jnp.int32(0), memory, observation, start, paths
    # Not a `while_loop`: on CPUs XLA runs what is inside one several times slower.
    decisions = -(-length // driver.interval)
    (last, _, _, end, paths), _ = jax.lax.scan(unless_over, carry, length=decisions)
    after = (jnp.arange(length + 1) > last)[:, None, None]
    position, rpy = jax.tree.map(
        lambda path, x: jnp.where(after, x, path), paths, position_and_rpy(end)
    )
    steps = jnp.asarray(end.time)
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
    )


def _decide(
    driver: Agent,
    params: TaskParams,
    memory: Any,
    observation: jax.Array,
    state: TaskState,
    keys: jax.Array,
) -> Any:
    """Memories, leaves `[P, ...]`, with what those intend that still drive.

    Planners imagine many futures of each vehicle, so that a few at a time fill the devices, and
    none are imagined once a task is over.
    """
    running = state.ending == TerminationReason.RUNNING
    together = min(_TOGETHER * parallel.number(), len(running))
    turns = -(-len(running) // together)
    # Those that drive come first, and the last turn is filled up with one that likely does not.
    filled = np.minimum(np.arange(turns * together), len(running) - 1)
    rows = jnp.argsort(~running)[filled].reshape(turns, together)
    decide = parallel.vmap(type(driver).decide, (None, None, 0, 0, 0, 0))

    def turn(rows: jax.Array) -> Any:
        of_some = jax.tree.map(lambda x: x[rows], (memory, observation, state, keys))
        return jax.lax.cond(
            jnp.any(running[rows]),
            lambda some: decide(driver, params, *some),
            lambda some: some[0],
            of_some,
        )

    decided = jax.lax.map(turn, rows)
    return jax.tree.map(lambda x, y: x.at[rows].set(y, mode="promise_in_bounds"), memory, decided)


@dataclasses.dataclass(frozen=True)
class Summary:
    """One row of a table of policies.

    tasks, successes: counts; success_interval: 95 % Wilson interval of the rate.
    seconds, seconds_deviation: mean and standard deviation over successes; NaN without any.
    abs_roll, abs_pitch: rad, mean over all steps of all episodes.
    driven: m, mean over all episodes.
    endings: how often each ending came, by name.
    """

    tasks: int
    successes: int
    success_interval: tuple[float, float]
    seconds: float
    seconds_deviation: float
    abs_roll: float
    abs_pitch: float
    driven: float
    endings: Mapping[str, int]

    @classmethod
    def of(cls, result: NavigationResult) -> Self:
        """The summary of some episodes."""
        success = np.asarray(result.success)
        steps = np.asarray(result.steps)
        seconds = np.asarray(result.seconds)[success]
        counts = np.bincount(np.asarray(result.ending), minlength=len(TerminationReason))
        return cls(
            tasks=len(success),
            successes=int(success.sum()),
            success_interval=wilson_interval(int(success.sum()), len(success)),
            seconds=float(seconds.mean()) if len(seconds) else math.nan,
            seconds_deviation=float(seconds.std()) if len(seconds) else math.nan,
            abs_roll=float(np.average(result.abs_roll, weights=steps)),
            abs_pitch=float(np.average(result.abs_pitch, weights=steps)),
            driven=float(np.mean(result.driven)),
            endings={e.name.lower(): int(counts[e]) for e in TerminationReason if counts[e]},
        )


def wilson_interval(successes: int, trials: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's score interval of a success rate, 95 % by default.

    Wilson (1927), Probable inference, the law of succession, and statistical inference.
    """
    rate = successes / trials
    middle = rate + z * z / (2 * trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def format_table(rows: Mapping[str, Summary]) -> str:
    """A Markdown table with the paper's columns, one row for each named policy."""
    header = ["policy", "success", "95 %", "time [s]", "roll [deg]", "pitch [deg]", "driven [m]"]
    cells: list[tuple[str, ...]] = [(*header, "endings")]
    for name, row in rows.items():
        low, high = (round(100 * bound) for bound in row.success_interval)
        time = f"{row.seconds:.1f} ± {row.seconds_deviation:.1f}" if row.successes else "-"
        endings = ", ".join(f"{ending} {count}" for ending, count in row.endings.items())
        cells.append(
            (
                name,
                f"{row.successes}/{row.tasks}",
                f"{low}-{high}",
                time,
                f"{math.degrees(row.abs_roll):.2f}",
                f"{math.degrees(row.abs_pitch):.2f}",
                f"{row.driven:.1f}",
                endings,
            )
        )
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    cells.insert(1, tuple("-" * width for width in widths))
    lines = (
        " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        for row in cells
    )
    return "\n".join(f"| {line} |" for line in lines)
