"""Action repeat: an environment whose actions are held for several steps."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from gymnax.environments import spaces
from gymnax.environments.environment import Environment

from vertiwm_jax.env.agent import Policy


def corrected(
    base: Policy | None, observation: jax.Array, key: jax.Array, correction: jax.Array
) -> jax.Array:
    """The action `[..., A]` of a controller plus a correction; without a base, the correction."""
    if base is None:
        return correction
    return jnp.clip(base(observation, key) + correction, -1.0, 1.0)


@dataclass(frozen=True)
class ActionRepeat(Environment):
    """Holds every action for `times` steps of `env`, or until the episode ends.

    Rewards are added up. After the end of an episode `env` must keep its state and give rewards
    of 0. Exploration noise that lasts moves a vehicle, where noise that changes at every step only
    shakes it, and there are fewer decisions to assign credit to (Mnih et al., 2015).

    base: a controller that acts at every step. The held action, in [-1, 1], is added to its
        action (Silver et al., 2018, "Residual policy learning").
    """

    env: Environment
    times: int
    base: Policy | None = None

    def reset_env(self, key: jax.Array, params: Any) -> tuple[jax.Array, Any]:
        return self.env.reset_env(key, params)

    def step_env(
        self, key: jax.Array, state: Any, action: int | float | jax.Array, params: Any
    ) -> tuple[jax.Array, Any, jax.Array, jax.Array, dict[Any, Any]]:
        keys = jax.random.split(key, self.times)

        def once(carry: tuple[jax.Array, Any], key: jax.Array) -> tuple:
            observation, state = carry
            acted = corrected(self.base, observation, key, jnp.asarray(action))
            observation, state, *result = self.env.step_env(key, state, acted, params)
            return (observation, state), result

        first = self.env.observe(key, state, None, params), state
        (observation, state), (rewards, terminated, info) = jax.lax.scan(once, first, keys)
        last = jax.tree.map(lambda x: x[-1], (terminated, info))
        return observation, state, jnp.sum(rewards), *last

    def is_truncated(self, state: Any, params: Any) -> jax.Array:
        return self.env.is_truncated(state, params)

    def action_space(self, params: Any) -> spaces.Box:
        return self.env.action_space(params)

    def observation_space(self, params: Any) -> spaces.Box:
        return self.env.observation_space(params)
