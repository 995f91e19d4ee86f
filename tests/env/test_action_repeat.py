from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import bicycle_env, ground, task

from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.observation import LAYOUT
from vertiwm_jax.env.task import NavigationConfig

KEY, ACTION = jax.random.key(0), jnp.array([0.6, 0.1])
# Equal environments share what it compiles.
STEP = jax.jit(NavigationEnv.step_env, static_argnums=0)


@pytest.fixture(scope="module")
def five():
    """An episode of five steps on level ground."""
    config = NavigationConfig(horizon_seconds=0.5)
    return bicycle_env(ground(), task((0.0, 0.0), (30.0, 0.0)), config)


def play(env, params, actions):
    """Observation, state, reward, terminated and info of steps that do not reset."""
    observation, state = env.start(params, 0)
    outputs = []
    for action in actions:
        given = action(observation) if callable(action) else action
        observation, state, *result = STEP(env, KEY, state, given, params)
        outputs.append((observation, state, *result))
    return outputs


def test_rewards_add_up_until_the_episode_ends(five):
    env, params = five
    single = play(env, params, [ACTION] * 5)
    held = play(replace(env, action_repeat=3), params, [ACTION] * 2)
    for (observation, state, reward, *_), last, steps in (
        (held[0], single[2], single[:3]),
        (held[1], single[4], single[3:]),
    ):
        np.testing.assert_allclose(observation, last[0], atol=1e-5)
        np.testing.assert_allclose(reward, sum(float(step[2]) for step in steps), rtol=1e-4)
        assert int(state.time) == int(last[1].time) and int(state.ending) == int(last[1].ending)
    assert not bool(env.is_truncated(held[0][1], params))
    assert bool(env.is_truncated(held[1][1], params)) and int(held[1][1].time) == 5


def test_an_episode_resets_as_that_of_the_environment(five):
    env, params = replace(five[0], action_repeat=3), five[1]
    _, state = env.reset(KEY, params)
    for _ in range(2):
        observation, state, _, _, truncated, info = env.step(KEY, state, ACTION, params)
    assert bool(truncated) and int(state.time) == 0
    np.testing.assert_array_equal(observation, params.start_observation[0])
    assert float(info["final_observation"][LAYOUT["velocity"].where][0]) > 0.1


def test_a_base_acts_at_every_step_and_the_held_action_corrects_it(five):
    env, params = five

    def base(observation, key):
        return observation[LAYOUT["last action"].where] / 2 + jnp.array([0.4, -0.9])

    def by_hand(observation):
        return jnp.clip(base(observation, KEY) + ACTION, -1.0, 1.0)

    single = play(env, params, [by_hand] * 3)
    [held] = play(replace(env, action_repeat=3, base=base), params, [ACTION])
    np.testing.assert_allclose(held[0], single[-1][0], atol=1e-5)
    np.testing.assert_allclose(held[2], sum(float(step[2]) for step in single), rtol=1e-4)
    assert not np.allclose(single[0][1].action, single[-1][1].action)
