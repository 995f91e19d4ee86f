"""Environments so small that what an algorithm must learn in them is known exactly."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment, spaces


@struct.dataclass
class ProbeState(environment.EnvState):
    observation: jax.Array


@struct.dataclass
class ProbeParams(environment.EnvParams):
    max_steps_in_episode: int = 1_000_000


@dataclass(frozen=True)
class Probe(environment.Environment):
    """One observed number, which starts as `start`; one action in [low, high].

    `steps` steps, then the end (`terminates`) or, by the parameters' limit, a truncation; from
    then on all stays as it is.
    """

    steps: int | None = 1

    def start(self, key: jax.Array) -> jax.Array:
        return jnp.zeros(())

    def reward(self, state: ProbeState, action: jax.Array) -> jax.Array:
        return jnp.ones(())

    def step_env(self, key, state, action, params):
        running = ~(self.is_terminated(state, params) | self.is_truncated(state, params))
        time = state.time + running
        new = ProbeState(time=time, observation=jnp.float32(time))
        over = self.is_terminated(new, params)
        reward = jnp.where(running, self.reward(state, action[0]), 0.0)
        return new.observation[None], new, reward, over, {"time": time}

    def reset_env(self, key, params):
        observation = self.start(key)
        state = ProbeState(time=jnp.zeros((), jnp.int32), observation=observation)
        return observation[None], state

    def observe(self, key, state, action, params):
        return state.observation[None]

    def is_terminated(self, state, params):
        return jnp.array(False) if self.steps is None else state.time >= self.steps

    def action_space(self, params):
        return spaces.Box(-2.0, 4.0, (1,))

    def observation_space(self, params):
        return spaces.Box(-10.0, 10.0, (1,))


@dataclass(frozen=True)
class Constant(Probe):
    """Reward 1 in every step."""


@dataclass(frozen=True)
class Sign(Probe):
    """One step; the reward is what is seen, -1 or 1."""

    def start(self, key):
        return jax.random.rademacher(key, (), jnp.float32)

    def reward(self, state, action):
        return state.observation


@dataclass(frozen=True)
class Delayed(Probe):
    """Two steps; only the second is rewarded, by 1."""

    steps: int = 2

    def reward(self, state, action):
        return jnp.float32(state.time)


@dataclass(frozen=True)
class Target(Probe):
    """One step; the best action is 1 plus what is seen, -1 or 1."""

    def start(self, key):
        return jax.random.rademacher(key, (), jnp.float32)

    def reward(self, state, action):
        return -((action - 1 - state.observation) ** 2)


@dataclass(frozen=True)
class Pictured(Target):
    """Also sees a picture of 4 x 4 cells, each of which shows the number in another way."""

    @staticmethod
    def pictured(seen: jax.Array) -> jax.Array:
        cells = jnp.arange(16.0)
        return jnp.concatenate([seen, (1 + cells) / 4 * seen + cells], axis=-1)

    def step_env(self, key, state, action, params):
        seen, *rest = super().step_env(key, state, action, params)
        return self.pictured(seen), *rest

    def reset_env(self, key, params):
        seen, state = super().reset_env(key, params)
        return self.pictured(seen), state


@dataclass(frozen=True)
class Endless(Probe):
    """Reward 1 in every step; only the time limit stops it, and nothing seen tells the time."""

    steps: int | None = None

    def step_env(self, key, state, action, params):
        _, state, reward, over, info = super().step_env(key, state, action, params)
        return jnp.zeros(1), state, reward, over, info


@dataclass(frozen=True)
class Staggered(Endless):
    """Its episodes begin up to four steps late, so that they are cut off at different times."""

    def reset_env(self, key, params):
        seen, state = super().reset_env(key, params)
        return seen, state.replace(time=jax.random.randint(key, (), 0, 5))


@dataclass(frozen=True)
class Broken(Probe):
    """Gives a reward that is not a number from the 40th step on."""

    steps: int | None = None

    def reward(self, state, action):
        return jnp.where(state.time >= 40, jnp.nan, 1.0)
