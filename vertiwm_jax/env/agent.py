"""What drives a vehicle through its task: functions of an observation, and agents that remember."""

from abc import ABC, abstractmethod
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.env.task import TaskParams, TaskState

Memory = Any


class Policy(Protocol):
    """`[O]` observation and a key to a `[2]` action in [-1, 1].

    A pytree that can be called: what it has learned are leaves, so that other weights of the
    same shapes do not compile again.
    """

    def __call__(self, observation: jax.Array, key: jax.Array) -> jax.Array: ...


@struct.dataclass
class Now:
    """One episode at the moment of a decision.

    task: what the environment is run with; of its terrain an agent may know what
        `task.observed_map(state)` gives. observation: `[O]`.
    """

    task: TaskParams
    state: TaskState
    observation: jax.Array


class Agent(ABC):
    """Plans every `interval` steps and acts at each, and carries a memory of its own.

    A pytree, like a `Policy`; `interval` is static. Its methods are of one episode.
    """

    interval = 1

    def init(self, now: Now) -> Memory:
        """The memory at the beginning of an episode; none by default."""
        return None

    def plan(self, now: Now, memory: Memory, key: jax.Array) -> Memory:
        """The memory with a plan for the next `interval` steps; as it is by default."""
        return memory

    @abstractmethod
    def act(self, now: Now, memory: Memory, key: jax.Array) -> tuple[jax.Array, Memory]:
        """A `[2]` action in [-1, 1], and the memory after it."""


@struct.dataclass
class Reactive(Agent):
    """A policy as an agent: it acts on what it sees, and remembers nothing."""

    policy: Policy

    def act(self, now: Now, memory: None, key: jax.Array) -> tuple[jax.Array, None]:
        return self.policy(now.observation, key), None


def corrected(
    base: Policy | None, observation: jax.Array, key: jax.Array, correction: jax.Array
) -> jax.Array:
    """The action `[..., A]` of a controller plus a correction; without a base, the correction."""
    if base is None:
        return correction
    return jnp.clip(base(observation, key) + correction, -1.0, 1.0)


def as_agent(driver: Policy | Agent) -> Agent:
    """A policy made an agent; an agent as it is."""
    return driver if isinstance(driver, Agent) else Reactive(driver)
