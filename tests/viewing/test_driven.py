import jax
import numpy as np
from env.worlds import bicycle_env, ground, hills, task

from vertiwm_jax.env.controllers import StraightToGoal
from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.viewing import driven


def test_a_policy_drives_as_it_is_judged():
    config = NavigationConfig(horizon_seconds=20.0)
    env, params = bicycle_env(ground(hills()), task((-20.0, 0.0), (20.0, 5.0)), config)
    policy, key = StraightToGoal(config), jax.random.key(0)
    scene = driven.drive(env, params, policy, key, "straight")
    position, rpy = run_episodes(env, params, policy, key).path(0)
    assert 50 < scene.steps < 200
    assert scene.title == f"straight: goal, {scene.steps / 10:.1f} s"
    np.testing.assert_allclose(scene.state[:, :3], position, atol=1e-3)
    np.testing.assert_allclose(scene.state[:, 3:6], rpy, atol=1e-3)
    # A bicycle follows its commanded speed with a lag.
    assert scene.command.shape == (scene.steps, 2) and np.ptp(scene.command[:, 1]) > 0
    np.testing.assert_allclose(scene.command[-1, 0], scene.state[-1, 6], atol=0.5)
    assert scene.wheels is None and scene.coefficients is None
