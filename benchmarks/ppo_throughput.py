"""Claim: PPO trains on the built-in simulator at 5,000 transitions/s on 2 cores, all included.

Beside it the same algorithm on an environment that costs nothing, which is the algorithm alone,
with an observation of the same size.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment, spaces

from benchmarks._harness import Figures, measure, parser, report
from vertiwm_jax.env.observation import OBSERVATION_SIZE
from vertiwm_jax.ppo import PPOTraining
from vertiwm_jax.rl import task
from vertiwm_jax.rl.ppo import PPO


@struct.dataclass
class Idle(environment.EnvState):
    observation: jax.Array


@dataclass(frozen=True)
class IdleEnv(environment.Environment):
    """Decays to what the action says; episodes of the length of a navigation task."""

    def step_env(self, key, state, action, params):
        observation = 0.9 * state.observation + 0.1 * jnp.sum(action)
        reward = -jnp.mean(jnp.abs(observation))
        state = Idle(time=state.time + 1, observation=observation)
        return observation, state, reward, jnp.array(False), {}

    def reset_env(self, key, params):
        observation = jax.random.normal(key, (OBSERVATION_SIZE,))
        return observation, Idle(time=jnp.int32(0), observation=observation)

    def action_space(self, params):
        return spaces.Box(-1.0, 1.0, (2,))


def iteration(ppo: PPO, params: Any, repeat: int = 1) -> Figures:
    state = jax.jit(ppo.init)(params, jax.random.key(0))
    figures = measure(jax.jit(ppo.iterate), params, state, repeats=3)
    return {"transitions_per_s": repeat * ppo.config.collected / figures["median_s"], **figures}


def main() -> None:
    arguments = parser(__doc__).parse_args()
    config = PPOTraining()
    params = environment.EnvParams(max_steps_in_episode=600)
    results = {"algorithm alone": iteration(PPO(IdleEnv(), config.ppo), params)}
    training, _ = task.environments(config)
    ppo = config.algorithm(training.env)
    results["built-in simulator"] = iteration(ppo, training.params, config.action_repeat)
    report("ppo_throughput", results, arguments.json)


if __name__ == "__main__":
    main()
