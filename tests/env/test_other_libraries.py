"""Agents of other libraries learn on the environment as it is."""

import jax
import numpy as np
import pytest
from env.worlds import bicycle_env, ground, hills

from vertiwm_jax.env.gymnasium import NavigationGymEnv
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.reward import RewardConfig
from vertiwm_jax.env.suites import circle_tasks
from vertiwm_jax.env.task import NavigationConfig

METER = 50  # What it is rewarded by to be a meter nearer to the goal.


@pytest.fixture(scope="module")
def made():
    """Episodes of 4 s on hills, whose ends cost nothing."""
    terrain = ground(hills())
    reward = RewardConfig(timed_out=0.0, timed_out_distance=0.0)
    config = NavigationConfig(horizon_seconds=4.0, reward=reward)
    return bicycle_env(terrain, circle_tasks(terrain, radius=30.0), config)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("normalized", [False, True])
def test_ppo_of_stable_baselines_learns(made, normalized):
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_checker import check_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    check_env(NavigationGymEnv(*made))
    env = DummyVecEnv([lambda: Monitor(NavigationGymEnv(*made))] * 2)
    if normalized:
        env = VecNormalize(env, gamma=0.8)
    agent = stable_baselines3.PPO(
        "MlpPolicy", env, learning_rate=1e-3, n_steps=128, gamma=0.8, seed=0, device="cpu"
    )

    def mean_return() -> float:
        """`Monitor` counts rewards that are not normalized."""
        return float(np.mean(evaluate_policy(agent, env, n_eval_episodes=20)[0]))

    before = mean_return()
    agent.learn(4096)
    assert mean_return() > before + 5 * METER


class OneEnd(NavigationEnv):
    """For libraries that were made for gymnax before 1.0, as docs/gymnasium.md has it."""

    def step(self, key, state, action, params=None):
        observation, state, reward, *ends, info = super().step(key, state, action, params)
        return observation, state, reward, ends[0] | ends[1], info


@pytest.mark.slow
def test_ppo_of_rejax_learns(made):
    rejax = pytest.importorskip("rejax")
    env, params = made
    agent = rejax.PPO.create(
        env=OneEnd(env.dynamics, env.config), env_params=params, num_envs=16, num_steps=64,
        num_epochs=4, num_minibatches=8, total_timesteps=2**15, eval_freq=2**14,
        learning_rate=3e-4, max_grad_norm=0.5, gamma=0.95, normalize_observations=True,
        normalize_rewards=True,
    )  # fmt: skip
    _, (_, returns) = jax.jit(agent.train)(jax.random.key(0))
    before, *_, after = np.mean(returns, axis=1)
    assert after > before + 2 * METER
