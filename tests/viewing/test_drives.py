from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import bicycle_env, ground, hills, task
from flax import struct
from learning import recordings

from vertiwm_jax.env.controllers import StraightToGoal
from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.mechanics.kinematic import ConstantVelocity
from vertiwm_jax.viewing import drives


def test_a_policy_drives_as_it_is_judged():
    config = NavigationConfig(horizon_seconds=20.0)
    env, params = bicycle_env(ground(hills()), task((-20.0, 0.0), (20.0, 5.0)), config)
    policy, key = StraightToGoal(config), jax.random.key(0)
    scene = drives.drive(env, params, policy, key, "straight")
    position, rpy = run_episodes(env, params, policy, key).path(0)
    assert 50 < scene.steps < 200
    assert scene.title == f"straight: goal, {scene.steps / 10:.1f} s"
    np.testing.assert_allclose(scene.state[:, :3], position, atol=1e-3)
    np.testing.assert_allclose(scene.state[:, 3:6], rpy, atol=1e-3)
    # A bicycle follows its commanded speed with a lag.
    assert scene.command.shape == (scene.steps, 2) and np.ptp(scene.command[:, 1]) > 0
    np.testing.assert_allclose(scene.command[-1, 0], scene.state[-1, 6], atol=0.5)
    assert scene.wheels is None and scene.coefficients is None


@struct.dataclass
class History:
    """Counts the steps."""

    coefficients: object


@dataclass(frozen=True)
class Fused:
    """Stands still; its coefficients count the steps."""

    def init(self, params, terrain, state):
        return History(jnp.zeros(4))

    def step(self, params, terrain, history, state, command):
        return state, History(history.coefficients + 1)


def test_predictions_from_recorded_states(tmp_path):
    path = recordings.write(tmp_path, **recordings.wheel_signals())
    scene = drives.recorded(path, 3, "constant", ConstantVelocity(), None)
    assert scene.title == "a, drive 3, and constant" and scene.steps == recordings.STEPS
    expected = recordings.drives()
    np.testing.assert_allclose(scene.state, expected["state"][3])
    np.testing.assert_allclose(scene.command, expected["control"][3])
    assert scene.wheels.wheel_omega.shape == (recordings.STEPS + 1, 4)
    # 40 steps: one prediction after the first 16, and none of the last 8.
    assert scene.prediction.start.tolist() == [16]
    np.testing.assert_allclose(scene.prediction.state[0], scene.state[16:33], atol=1e-5)
    assert scene.prediction.coefficients is None and scene.prediction.sinkage is None


def test_coefficients_of_the_predicted_steps(tmp_path):
    scene = drives.recorded(recordings.write(tmp_path), 0, "fused", Fused(), None)
    np.testing.assert_allclose(scene.prediction.coefficients[0, :, 2], 16 + np.arange(1, 17))
    np.testing.assert_allclose(scene.prediction.state[0, 1:], np.tile(scene.state[16], (16, 1)))


def test_drives_that_are_none_are_named(tmp_path):
    path = recordings.write(tmp_path)
    with pytest.raises(DataError, match=r"a\.npz: drive: expected 0 to 24, found 25"):
        drives.recorded(path, 25, "constant", ConstantVelocity(), None)
    length = recordings.drives()["length"]
    length[2] = 31
    recordings.write(tmp_path, length=length)
    with pytest.raises(DataError, match="drive 2: expected at least 32 steps, found 31"):
        drives.recorded(path, 2, "constant", ConstantVelocity(), None)
