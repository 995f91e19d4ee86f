import jax
import jax.numpy as jnp
import numpy as np
from rl.probes import Delayed, Endless, ProbeParams, Target

from vertiwm_jax.rl.ppo import PPO, PPOConfig
from vertiwm_jax.training import NONE


def roll(env, params, actions):
    """Steps `[T, N]` of given actions `[T, N, 1]`, and what came after each step."""

    config = PPOConfig(num_envs=actions.shape[1], discount=0.9)
    algorithm = PPO(env, config, lambda info: {"time": info["time"]})

    def advance(running, inputs):
        running, experience, final = algorithm.step(params, running, *inputs)
        return running, (experience, final, running.observation)

    key = jax.random.key(0)
    start = algorithm.start(params, key, key)["environments"]
    keys = jax.random.split(jax.random.key(1), actions.shape[:2])
    return jax.lax.scan(advance, start, (actions, keys))[1]


def test_returns_of_episodes_begin_anew_with_them():
    experience, _, _ = roll(Delayed(), ProbeParams(), jnp.zeros((5, 2, 1)))
    # Rewards 0 and 1, then a new episode.
    np.testing.assert_array_equal(experience.terminated[:, 0], [0, 1, 0, 1, 0])
    np.testing.assert_array_equal(experience.reward[:, 1], [0, 1, 0, 1, 0])
    np.testing.assert_array_equal(experience.episode_return[:, 0], [0, 1, 0, 1, 0])
    np.testing.assert_array_equal(experience.episode_length[:, 1], [1, 2, 1, 2, 1])


def test_a_truncated_episode_ends_without_termination():
    params = ProbeParams(max_steps_in_episode=3)
    experience, _, _ = roll(Endless(), params, jnp.zeros((6, 1, 1)))
    np.testing.assert_array_equal(experience.truncated[:, 0], [0, 0, 1, 0, 0, 1])
    assert not bool(jnp.any(experience.terminated))
    expected = [1, 1.9, 2.71, 1, 1.9, 2.71]
    np.testing.assert_allclose(experience.discounted_return[:, 0], expected, rtol=1e-6)
    means = experience.episode_metrics()
    assert float(means["episodes"]) == 2 and float(means["episode_length"]) == 3
    assert float(means["time"]) == 3


def test_no_episode_has_no_mean():
    experience, _, _ = roll(Endless(), ProbeParams(), jnp.zeros((2, 1, 1)))
    means = experience.episode_metrics()
    assert float(means["episodes"]) == 0 and means["episode_return"] == NONE


def test_actions_are_clipped_and_scaled_to_the_range():
    actions = jnp.array([[[-5.0], [-1.0], [0.0], [2.0]]])
    experience, final, after = roll(Target(), ProbeParams(), actions)
    bounded = np.array([-2.0, -2.0, 1.0, 4.0])  # of [-2, 4]
    expected = -((bounded - 1 - experience.observation[0, :, 0]) ** 2)
    np.testing.assert_allclose(experience.reward[0], expected, rtol=1e-6)
    np.testing.assert_array_equal(final[0, :, 0], 1.0)  # the end of the one step
    assert set(np.asarray(after[0, :, 0]).tolist()) <= {-1.0, 1.0}  # new beginnings
