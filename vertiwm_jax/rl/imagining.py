"""What drivers that look ahead share: a model that they imagine in, and what is imagined there."""

from abc import abstractmethod
from dataclasses import replace
from typing import Self

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.dynamics import History, Params, step
from vertiwm_jax.env.action_repeat import ActionRepeat, corrected
from vertiwm_jax.env.agent import Agent, Now
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import TaskParams, TaskState


@struct.dataclass
class Plan:
    """What a driver that looks ahead carries.

    history: of the model that it imagines in, along the way really driven.
    corrections: `[D, 2]` of the base, of which the first is held until the next decision; the
        actions themselves without a base.
    """

    history: History
    corrections: jax.Array


@struct.dataclass
class Future:
    """An episode as imagined so far.

    observation, state: where it has led to.
    weight: `[]` of what comes next; 0 once it is over. total: `[]` discounted rewards.
    """

    observation: jax.Array
    state: TaskState
    weight: jax.Array
    total: jax.Array

    @classmethod
    def of(cls, now: Now) -> Self:
        """Nothing is imagined yet."""
        return cls(now.observation, now.state, jnp.float32(1), jnp.float32(0))


def around(usual: jax.Array, number: int, spread: float, key: jax.Array) -> jax.Array:
    """`[number, ...]` candidates in [-1, 1] about the usual `[...]`, which is the first."""
    noise = jax.random.normal(key, (number, *usual.shape)).at[0].set(0.0)
    return jnp.clip(usual + spread * noise, -1.0, 1.0)


@struct.dataclass
class Imagining(Agent):
    """Knows a model to imagine in, which needs not be the one that the vehicle really follows.

    Every decision is held for `interval` steps. Static like it: `discount`, for each decision;
    `planned`, how many of them a plan keeps; and `base`, a controller that acts at every step, and
    that decisions correct.

    env: the task inside the model, static; dynamics: the model's parameters.
    """

    discount = 1.0
    planned = 1
    base = None

    env: NavigationEnv = struct.field(pytree_node=False)
    dynamics: Params

    def init(self, now: Now) -> Plan:
        """The model's first history, and no correction."""
        terrain = now.task.observed_map(now.state)
        history = self.env.dynamics.init(self.dynamics, terrain, now.state.vehicle)
        return Plan(history, jnp.zeros((self.planned, 2)))

    def act(self, now: Now, memory: Plan, key: jax.Array) -> tuple[jax.Array, Plan]:
        """The base, corrected as planned; the model's history follows the vehicle."""
        action = corrected(self.base, now.observation, key, memory.corrections[0])
        terrain = now.task.observed_map(now.state)
        command = now.task.vehicle.command(action, self.env.config.speed_range)
        given = self.dynamics, terrain, memory.history, now.state.vehicle, command
        _, history = step(self.env.dynamics, *given)
        return action, replace(memory, history=history)

    @abstractmethod
    def imagine(self, now: Now, candidate: jax.Array, key: jax.Array) -> jax.Array:
        """The discounted return `[]` of a candidate; `now` is inside the model."""

    def returns(self, now: Now, memory: Plan, candidates: jax.Array, key: jax.Array) -> jax.Array:
        """`[N]` what candidates `[N, ...]` would return from where the vehicle is."""
        each = jax.vmap(self.imagine, (None, 0, None))
        return each(self.inside(now, memory), candidates, key)

    def inside(self, now: Now, memory: Plan) -> Now:
        """The task as it is now, inside the model; the map as observed is the true one there."""
        terrain = now.task.observed_map(now.state)
        task = replace(now.task, dynamics=self.dynamics, terrain=terrain)
        state = replace(now.state, history=memory.history, observed=None)
        return replace(now, task=task, state=state)

    def hold(
        self, task: TaskParams, future: Future, correction: jax.Array, key: jax.Array
    ) -> Future:
        """What one more decision `[2]` leads to, in the task inside the model."""
        env = ActionRepeat(self.env, self.interval, self.base)
        observation, state, reward, ended, _ = env.step_env(key, future.state, correction, task)
        total = future.total + future.weight * reward
        ended = ended | env.is_truncated(state, task)
        weight = jnp.where(ended, 0.0, future.weight * self.discount)
        return Future(observation, state, weight, total)
