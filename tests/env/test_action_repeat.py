from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rl.probes import Delayed, ProbeParams

from vertiwm_jax.env.action_repeat import ActionRepeat

KEY, ACTION = jax.random.key(0), jnp.ones(1)
ENV = Delayed(steps=5)  # rewards 0, 1, 2, 3, 4


def play(env, steps, env_params=ProbeParams(), action=ACTION):
    """Observation, state, reward, terminated, truncated of steps that do not reset."""
    _, state = env.reset_env(KEY, env_params)
    outputs = []
    for _ in range(steps):
        observation, state, reward, terminated, info = env.step_env(KEY, state, action, env_params)
        truncated = env.is_truncated(state, env_params)
        outputs.append((observation, state, reward, terminated, truncated, info))
    return outputs


@pytest.mark.parametrize(
    ("limit", "last_time", "last_reward", "ended"),
    [(100, 5, 3 + 4, (True, False)), (4, 4, 3, (False, True))],
)
def test_rewards_add_up_until_the_episode_ends(limit, last_time, last_reward, ended):
    params = ProbeParams(max_steps_in_episode=limit)
    first, last = play(ActionRepeat(ENV, 3), 2, params)
    assert float(first[0][0]) == int(first[1].time) == 3 and float(first[2]) == 0 + 1 + 2
    assert (bool(first[3]), bool(first[4])) == (False, False)
    observation, state, reward, terminated, truncated, info = last
    assert float(observation[0]) == int(state.time) == int(info["time"]) == last_time
    assert float(reward) == last_reward and (bool(terminated), bool(truncated)) == ended


def test_an_episode_resets_as_that_of_the_environment():
    env, params = ActionRepeat(ENV, 3), ProbeParams()
    _, state = env.reset(KEY, params)
    for _ in range(2):
        observation, state, _, terminated, _, info = env.step(KEY, state, ACTION, params)
    assert bool(terminated) and float(observation[0]) == int(state.time) == 0
    assert float(info["final_observation"][0]) == 5


def test_once_is_the_environment_itself():
    chex.assert_trees_all_equal(play(ActionRepeat(ENV, 1), 5), play(ENV, 5))


@dataclass(frozen=True)
class Echo(Delayed):
    """The reward is the action."""

    def reward(self, state, action):
        return action


def test_a_base_acts_at_every_step_and_the_held_action_corrects_it():
    def base(observation, key):  # sees 0, 1, 2, ...
        return observation / 2 - 0.75

    first, last = play(ActionRepeat(Echo(steps=5), 3, base), 2, action=jnp.full(1, 0.5))
    np.testing.assert_allclose(first[2], -0.25 + 0.25 + 0.75, rtol=1e-6)
    np.testing.assert_allclose(last[2], 1.0 + 1.0, rtol=1e-6)  # clipped, and over after two
