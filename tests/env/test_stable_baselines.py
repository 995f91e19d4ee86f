"""Agents of other libraries learn on the Gymnasium environment as it is."""

import numpy as np
import pytest
from env.worlds import bicycle_env, ground, hills

from vertiwm_jax.env.gymnasium import NavigationGymEnv
from vertiwm_jax.env.suites import circle_tasks
from vertiwm_jax.env.task import NavigationConfig


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_ppo_of_stable_baselines_learns():
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_checker import check_env
    from stable_baselines3.common.evaluation import evaluate_policy

    terrain = ground(hills())
    config = NavigationConfig(horizon_seconds=4.0)
    env = NavigationGymEnv(*bicycle_env(terrain, circle_tasks(terrain, radius=30.0), config))
    check_env(env)
    agent = stable_baselines3.PPO("MlpPolicy", env, n_steps=512, seed=0, gamma=0.95, device="cpu")

    def mean_return() -> float:
        return float(np.mean(evaluate_policy(agent, agent.get_env(), n_eval_episodes=20)[0]))

    before = mean_return()
    agent.learn(8 * 512)
    assert mean_return() > before + 100  # a metre nearer to the goal is 50
