"""Logs of a drive: what is seen, when, and how far off."""

import numpy as np
import pytest
from importers.logged import commands, states
from importers.noisy import noisy_logs
from scipy.spatial.transform import Rotation

NoiseConfig = noisy_logs.NoiseConfig
STEPS, SCALE = 400, 4.0
TIME = 0.1 * np.arange(STEPS + 1)
EXACT = NoiseConfig(position=0.0, attitude=0.0, latency=0.0, dropped=0.0)


def logged(config):
    rng = np.random.default_rng(0)
    return noisy_logs.logged(states(TIME), commands(TIME[:-1]), SCALE, config, rng)


def test_without_noise_a_log_has_the_states_in_between_at_the_vehicles_size():
    rows = logged(EXACT)
    np.testing.assert_allclose(np.diff(rows[:, 0]), 0.02)
    # A vehicle of a quarter of the size does all of it in half the time.
    assert len(rows) == 1000
    at = 2 * rows[:, 0]
    expected = states(at)
    np.testing.assert_allclose(4 * rows[:, 1:4], expected[:, :3], atol=1e-3)
    turned = Rotation.from_quat(rows[:, 4:8]).inv() * Rotation.from_euler(
        "ZYX", expected[:, 5:2:-1]
    )
    assert turned.magnitude().max() < 2e-3
    held = commands(0.1 * np.floor(at / 0.1 + 1e-6))
    np.testing.assert_allclose(rows[:, 8:] * [2, 1], held, atol=1e-6)


def test_noise_is_as_large_as_asked_and_late():
    config = NoiseConfig(position=0.01, attitude=0.02, latency=0.05, dropped=0.2)
    rows = logged(config)
    assert 0.7 < len(rows) / 1000 < 0.87 and rows[0, 0] >= 0.05
    expected = states(2 * (rows[:, 0] - 0.05))
    error = rows[:, 1:4] - expected[:, :3] / 4
    np.testing.assert_allclose(error.std(0), 0.01, rtol=0.1)
    turned = Rotation.from_quat(rows[:, 4:8]).inv() * Rotation.from_euler(
        "ZYX", expected[:, 5:2:-1]
    )
    np.testing.assert_allclose(turned.as_rotvec().std(0), 0.02, rtol=0.1)
    # Commands are as they were at the stamp.
    np.testing.assert_allclose(
        rows[:, 9], commands(0.1 * np.floor(20 * rows[:, 0] + 1e-6))[:, 1], atol=1e-6
    )


@pytest.mark.parametrize(
    ("name", "value"), [("rate", 0.0), ("position", -1.0), ("latency", np.nan), ("dropped", 1.0)]
)
def test_noise_that_cannot_be_is_named(name, value):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        NoiseConfig(**{name: value})
