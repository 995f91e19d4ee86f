"""Steps of environments side by side, which algorithms learn from."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments.environment import Environment

from vertiwm_jax import parallel

Metrics = dict[str, jax.Array]
Outcomes = Callable[[dict[str, jax.Array]], Metrics]
"""What to report of an episode, from the `info` of its last step: named scalars."""


@struct.dataclass
class Environments:
    """N running environments.

    state: the environment's own, leaves `[N, ...]`.
    observation: `[N, O]` what the policy sees next, not normalized.
    discounted_return: `[N]` of the running episode so far.
    episode_return, episode_length: `[N]` undiscounted sum of rewards and steps so far.
    """

    state: Any
    observation: jax.Array
    discounted_return: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array


@struct.dataclass
class Steps:
    """Steps of environments, `[..., N]`.

    observation: `[..., N, O]` before the step, not normalized; action: `[..., N, A]` as chosen, 1
        being the end of its range; terminated: what follows is worth nothing; truncated: time ran
        out; discounted_return, episode_return, episode_length: of the episodes, with this step;
        outcomes: leaves `[..., N]`, which mean something where an episode ended.
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    discounted_return: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array
    outcomes: Metrics

    @property
    def done(self) -> jax.Array:
        """`[..., N]` whether an episode ended."""
        return self.terminated | self.truncated


def start(env: Environment, data: Any, number: int, key: jax.Array) -> Environments:
    """The beginning of `number` episodes; `data` are the environment's parameters."""
    keys = jax.random.split(key, number)
    observation, state = jax.vmap(env.reset, (0, None))(keys, data)
    zeros = jnp.zeros(number)
    return Environments(state, observation, zeros, zeros, zeros)


def step(
    env: Environment,
    data: Any,
    outcomes: Outcomes,
    discount: float,
    environments: Environments,
    action: jax.Array,
    keys: jax.Array,
) -> tuple[Environments, Steps, jax.Array]:
    """A step of all environments; episodes that end begin anew.

    Args:
        data: the environment's parameters.
        action: `[N, A]`, clipped to [-1, 1] and scaled to the environment's range.
        keys: `[N]` random keys.

    Returns:
        The environments after the step, the step, and the observations `[N, O]` after it and
        before any new beginning.
    """
    space = env.action_space(data)
    low, high = jnp.asarray(space.low), jnp.asarray(space.high)
    bounded = low + (high - low) * (jnp.clip(action, -1, 1) + 1) / 2
    step_all = parallel.vmap(env.step, (0, 0, 0, None))
    observation, state, reward, terminated, truncated, info = step_all(
        keys, environments.state, bounded, data
    )
    steps = Steps(
        observation=environments.observation,
        action=action,
        reward=reward,
        terminated=terminated,
        truncated=truncated,
        discounted_return=discount * environments.discounted_return + reward,
        episode_return=environments.episode_return + reward,
        episode_length=environments.episode_length + 1,
        outcomes=jax.vmap(outcomes)(info),
    )

    def running(total: jax.Array) -> jax.Array:
        return jnp.where(steps.done, 0.0, total)

    environments = replace(
        environments,
        state=state,
        observation=observation,
        discounted_return=running(steps.discounted_return),
        episode_return=running(steps.episode_return),
        episode_length=running(steps.episode_length),
    )
    return environments, steps, info["final_observation"]


def episode_metrics(steps: Steps) -> Metrics:
    """Means over the episodes that ended on all devices, and how many did; NaN if none."""

    def sum_of_last(x: jax.Array) -> jax.Array:
        return jnp.sum(jnp.where(steps.done, x, 0.0))

    last = {
        "episode_return": steps.episode_return,
        "episode_length": steps.episode_length,
        **steps.outcomes,
    }
    count = jnp.sum(steps.done, dtype=jnp.float32)
    count, sums = parallel.total((count, jax.tree.map(sum_of_last, last)))
    return {"episodes": count, **jax.tree.map(lambda x: x / count, sums)}
