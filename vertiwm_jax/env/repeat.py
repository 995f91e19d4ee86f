"""Action repeat: the same environment, decided upon less often."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from gymnax.environments import spaces
from gymnax.environments.environment import Environment


@dataclass(frozen=True)
class ActionRepeat(Environment):
    """Holds every action for `times` steps of `env`, or until the episode ends.

    Rewards add up. Exploration noise that lasts moves a vehicle where noise that changes at every
    step only shakes it, and credit is given to fewer decisions (Mnih et al., 2015).
    """

    env: Environment
    times: int

    def reset_env(self, key: jax.Array, params: Any) -> tuple[jax.Array, Any]:
        return self.env.reset_env(key, params)

    def step_env(
        self, key: jax.Array, state: Any, action: int | float | jax.Array, params: Any
    ) -> tuple[jax.Array, Any, jax.Array, jax.Array, dict[Any, Any]]:
        keys = jax.random.split(key, self.times)
        first = self.env.step_env(keys[0], state, action, params)

        def again(result: tuple, key: jax.Array) -> tuple[tuple, None]:
            _, state, reward, terminated, _ = result
            over = terminated | self.env.is_truncated(state, params)
            more = self.env.step_env(key, state, action, params)
            more = (*more[:2], reward + more[2], *more[3:])
            return jax.tree.map(lambda old, new: jnp.where(over, old, new), result, more), None

        return jax.lax.scan(again, first, keys[1:])[0]

    def is_truncated(self, state: Any, params: Any) -> jax.Array:
        return self.env.is_truncated(state, params)

    def is_terminated(self, state: Any, params: Any) -> jax.Array:
        return self.env.is_terminated(state, params)

    def action_space(self, params: Any) -> spaces.Box:
        return self.env.action_space(params)

    def observation_space(self, params: Any) -> spaces.Box:
        return self.env.observation_space(params)
