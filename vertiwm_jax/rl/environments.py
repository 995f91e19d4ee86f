"""Environments side by side, and what an algorithm experiences in them."""

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
    observation: `[N, O]` what the policy sees next, not normalised.
    discounted_return: `[N]` of the running episode so far.
    episode_return, episode_length: `[N]` undiscounted sum of rewards and steps so far.
    """

    state: Any
    observation: jax.Array
    discounted_return: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array


@struct.dataclass
class Experience:
    """Steps of environments, `[..., N]`.

    observation: `[..., N, O]` before the step, not normalised; action: `[..., N, A]` as chosen, 1
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


def start(env: Environment, env_params: Any, number: int, key: jax.Array) -> Environments:
    """The beginning of `number` episodes."""
    keys = jax.random.split(key, number)
    observation, state = parallel.vmap(env.reset, (0, None))(keys, env_params)
    zeros = jnp.zeros(number)
    return Environments(state, observation, zeros, zeros, zeros)


def step(
    env: Environment,
    env_params: Any,
    outcomes: Outcomes,
    discount: float,
    environments: Environments,
    action: jax.Array,
    key: jax.Array,
) -> tuple[Environments, Experience, jax.Array]:
    """A step of all; episodes that end begin anew.

    action: `[N, A]`, clipped to [-1, 1] and scaled to the environment's range. Also gives the
    observations `[N, O]` after the step and before any new beginning.
    """
    space = env.action_space(env_params)
    low, high = jnp.asarray(space.low), jnp.asarray(space.high)
    bounded = low + (high - low) * (jnp.clip(action, -1, 1) + 1) / 2
    keys = jax.random.split(key, len(action))
    step_all = parallel.vmap(env.step, (0, 0, 0, None))
    observation, state, reward, terminated, truncated, info = step_all(
        keys, environments.state, bounded, env_params
    )
    experience = Experience(
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
        return jnp.where(experience.done, 0.0, total)

    environments = replace(
        environments,
        state=state,
        observation=observation,
        discounted_return=running(experience.discounted_return),
        episode_return=running(experience.episode_return),
        episode_length=running(experience.episode_length),
    )
    return environments, experience, info["final_observation"]


def episodes(experience: Experience) -> Metrics:
    """Means over the episodes that ended, and how many did; NaN if none."""
    done = experience.done
    count = jnp.sum(done)

    def mean(x: jax.Array) -> jax.Array:
        return jnp.sum(jnp.where(done, x, 0.0)) / count

    return {
        "episodes": count,
        "episode_return": mean(experience.episode_return),
        "episode_length": mean(experience.episode_length),
        **jax.tree.map(mean, experience.outcomes),
    }
