"""What drives a vehicle through its task: functions of an observation, and those that remember."""

from abc import ABC, abstractmethod
from typing import Any, Protocol

import jax
from flax import struct

from vertiwm_jax.env.task import TaskParams, TaskState

Memory = Any


class Policy(Protocol):
    """`[O]` observation and a key to a `[2]` action in [-1, 1].

    A pytree that can be called: what it has learned are leaves, so that other weights of the
    same shapes do not compile again.
    """

    def __call__(self, observation: jax.Array, key: jax.Array) -> jax.Array: ...


class Agent(ABC):
    """Decides every `interval` steps and acts at each, and carries a memory of its own.

    A pytree, like a `Policy`; `interval` is static. It sees the state that the task is in, which
    its methods get of one episode; the parameters are those of the environment that it drives in,
    of whose terrain it may know what `params.believed(state)` gives.
    """

    interval = 1

    def start(self, params: TaskParams, state: TaskState) -> Memory:
        """The memory at the beginning of an episode; none, by default."""
        return None

    def decide(
        self,
        params: TaskParams,
        memory: Memory,
        observation: jax.Array,
        state: TaskState,
        key: jax.Array,
    ) -> Memory:
        """The memory with what is intended for the next `interval` steps; by default as it is."""
        return memory

    @abstractmethod
    def act(
        self,
        params: TaskParams,
        memory: Memory,
        observation: jax.Array,
        state: TaskState,
        key: jax.Array,
    ) -> tuple[jax.Array, Memory]:
        """A `[2]` action in [-1, 1], and the memory after it."""


@struct.dataclass
class Reactive(Agent):
    """A policy as a driver: it acts on what it sees, and remembers nothing."""

    policy: Policy

    def act(
        self,
        params: TaskParams,
        memory: None,
        observation: jax.Array,
        state: TaskState,
        key: jax.Array,
    ) -> tuple[jax.Array, None]:
        """What the policy says."""
        return self.policy(observation, key), None
