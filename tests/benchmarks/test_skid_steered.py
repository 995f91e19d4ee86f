import json

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import skid_steered
from benchmarks.skid_steered import START, STEPS, Logs
from vertiwm_jax.mechanics.kinematic import DifferentialParams
from vertiwm_jax.terrain.map import TerrainMap

RADIUS, TRACK = 0.2, 0.6


def written(path, windows=12):
    """Windows of a robot that drives at 0.8 of the commanded speed and a third of its turn, and
    whose poses are held at every second sample."""
    rng = np.random.default_rng(0)
    time = 0.05 * np.arange(40)
    speed, turn = rng.uniform(-1, 1, windows), rng.uniform(-2, 2, windows)
    yaw = turn[:, None] / 3 * time
    x = 0.8 * speed[:, None] * np.sin(yaw) / (turn[:, None] / 3)
    y = 0.8 * speed[:, None] * (1 - np.cos(yaw)) / (turn[:, None] / 3)
    pose = np.zeros((windows, 40, 6))
    pose[..., 0], pose[..., 1], pose[..., 5] = x, y, yaw
    pose[:, 0::2] = np.concatenate([pose[:, :1], pose[:, 1:-1:2]], axis=1)

    def wheels(speed, turn):
        sides = np.stack([speed - turn * TRACK / 2, speed + turn * TRACK / 2], axis=1) / RADIUS
        return np.repeat(sides[:, None], 40, axis=1)

    imu = np.repeat([[0, 0, 9.81, 0]], 40, axis=0) + np.zeros((windows, 40, 4))
    imu[..., 3] = turn[:, None] / 3
    meta = {"vehicle": {"wheelbase": 0.5, "track": TRACK, "wheel_radius": RADIUS, "name": "husky"}}
    np.savez(
        path,
        pose=pose,
        command=wheels(speed, turn),
        wheel=wheels(0.8 * speed / skid_steered.WHEEL_SHARE, turn),
        imu=imu,
        step=np.arange(windows) // 3,
        meta=json.dumps(meta),
    )
    return speed, turn


@pytest.mark.parametrize("sensors", [False, True])
def test_states_and_slip_of_windows_are_found_again(tmp_path, sensors):
    speed, turn = written(tmp_path / "robot.npz")
    logs = Logs.of(tmp_path / "robot.npz")
    np.testing.assert_allclose(logs.command[:, 3, 0], speed, atol=1e-6)
    assert logs.fresh.mean() == pytest.approx(0.5, abs=0.03)
    state = skid_steered.estimated(logs, sensors)
    np.testing.assert_allclose(state.velocity[:, 0], 0.8 * speed, atol=0.02)
    np.testing.assert_allclose(state.angular_velocity[:, 2], turn / 3, atol=1e-3)
    ground = TerrainMap.from_array(np.zeros((9, 9)), "concrete", resolution=8.0)
    ideal = DifferentialParams(*map(jnp.float32, (*logs.geometry, 1, 1, 0.01, 0.01, 0, 0)))
    found = skid_steered.fitted(ideal, ground, state, logs)
    assert float(found.speed_gain) == pytest.approx(0.8, abs=0.03)
    assert float(found.turn_gain) == pytest.approx(1 / 3, abs=0.02)


@pytest.mark.integration
def test_errors_are_told_by_model_with_intervals_over_steps(tmp_path, monkeypatch):
    written(tmp_path / "robot.npz")
    monkeypatch.setattr(skid_steered, "FITTED", 6)
    made = skid_steered.rows(tmp_path / "robot.npz")
    fitted = made["robot: differential drive (poses)"]
    assert 0 < fitted["position_m_low"] <= fitted["position_m"] <= fitted["position_m_high"]
    # What is held for a sample of 0.05 s is up to that late.
    assert fitted["position_m"] < 0.06
    assert made["robot: differential drive without slip (poses)"]["yaw_rad"] > 0.3
    # The numbers of a Husky, which this robot is not.
    assert 0 < made["robot: simulator (poses, wheels, gyroscope)"]["position_m"] < 1.0


def test_the_predicted_pose_is_that_at_the_last_sample(tmp_path):
    written(tmp_path / "robot.npz")
    logs = Logs.of(tmp_path / "robot.npz")
    assert logs.xy.shape[1] - 1 == START + 2 * STEPS
    state = skid_steered.estimated(logs, sensors=True)
    states = state.position.at[:, :2].set(logs.xy[:, -1])
    there = state.replace(position=states, rpy=state.rpy.at[:, 2].set(logs.yaw[:, -1]))
    np.testing.assert_allclose(skid_steered.errors(there, logs), 0, atol=1e-6)
