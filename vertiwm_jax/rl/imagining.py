"""What drivers that look ahead share: a model that they imagine in, and what is imagined there."""

from abc import abstractmethod
from dataclasses import replace
from typing import Self

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.dynamics import History, Params, step
from vertiwm_jax.env.action_repeat import ActionRepeat, corrected
from vertiwm_jax.env.agent import Agent
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
    def of(cls, observation: jax.Array, state: TaskState) -> Self:
        """Nothing is imagined yet."""
        return cls(observation, state, jnp.float32(1), jnp.float32(0))


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

    def start(self, params: TaskParams, state: TaskState) -> Plan:
        """The model's first history, and no correction."""
        terrain = params.believed(state)
        history = self.env.dynamics.init(self.dynamics, terrain, state.vehicle)
        return Plan(history, jnp.zeros((self.planned, 2)))

    def act(
        self,
        params: TaskParams,
        memory: Plan,
        observation: jax.Array,
        state: TaskState,
        key: jax.Array,
    ) -> tuple[jax.Array, Plan]:
        """The base, corrected as planned; the model's history follows the vehicle."""
        action = corrected(self.base, observation, key, memory.corrections[0])
        terrain = params.believed(state)
        command = params.vehicle.command(action, self.env.config.speed_range)
        given = self.dynamics, terrain, memory.history, state.vehicle, command
        _, history = step(self.env.dynamics, *given)
        return action, replace(memory, history=history)

    @abstractmethod
    def imagine(
        self,
        params: TaskParams,
        observation: jax.Array,
        state: TaskState,
        candidate: jax.Array,
        key: jax.Array,
    ) -> jax.Array:
        """The discounted return `[]` of a candidate, in the task inside the model."""

    def returns(
        self,
        params: TaskParams,
        memory: Plan,
        observation: jax.Array,
        state: TaskState,
        candidates: jax.Array,
        key: jax.Array,
    ) -> jax.Array:
        """`[N]` what candidates `[N, ...]` would return from where the vehicle is."""
        params, state = self.inside(params, memory, state)
        each = jax.vmap(self.imagine, (None, None, None, 0, None))
        return each(params, observation, state, candidates, key)

    def inside(
        self, params: TaskParams, memory: Plan, state: TaskState
    ) -> tuple[TaskParams, TaskState]:
        """The task as it is now, inside the model; what is believed of the map is true there."""
        params = replace(params, dynamics=self.dynamics, terrain=params.believed(state))
        return params, replace(state, history=memory.history, belief=None)

    def hold(
        self, params: TaskParams, future: Future, correction: jax.Array, key: jax.Array
    ) -> Future:
        """What one more decision `[2]` leads to, in the task inside the model."""
        env = ActionRepeat(self.env, self.interval, self.base)
        observation, state, reward, ended, _ = env.step_env(key, future.state, correction, params)
        total = future.total + future.weight * reward
        ended = ended | env.is_truncated(state, params)
        weight = jnp.where(ended, 0.0, future.weight * self.discount)
        return Future(observation, state, weight, total)
