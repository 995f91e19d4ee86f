"""Units, frames and what is refused of a log."""

from dataclasses import replace

import numpy as np
import pytest
from importers.logged import SETTINGS, logged
from scipy.spatial.transform import Rotation

from vertiwm_jax.importers.log import Log, converted
from vertiwm_jax.importers.settings import Frames, ImportSettings, Units, VehicleSettings
from vertiwm_jax.learning.schema import DataError


@pytest.fixture
def arrays():
    seen = logged(seconds=4)
    return {
        "time": seen.time,
        "position": seen.state[:, :3],
        "attitude": seen.state[:, 3:6],
        "velocity": seen.state[:, 6:9],
        "angular_velocity": seen.state[:, 9:12],
        "command_time": seen.time,
        "command": seen.command,
    }


def assert_same(found, expected):
    for name in ("time", "position", "velocity", "angular_velocity", "command_time", "command"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-9)
    assert (found.rotation.inv() * expected.rotation).magnitude().max() < 1e-9


def test_roll_pitch_yaw_are_rz_ry_rx(arrays):
    found = converted(Log(**arrays), "a", SETTINGS)
    c, s = np.cos(arrays["attitude"].T), np.sin(arrays["attitude"].T)
    for k in range(len(arrays["time"])):
        x = np.array([[1, 0, 0], [0, c[0, k], -s[0, k]], [0, s[0, k], c[0, k]]])
        y = np.array([[c[1, k], 0, s[1, k]], [0, 1, 0], [-s[1, k], 0, c[1, k]]])
        z = np.array([[c[2, k], -s[2, k], 0], [s[2, k], c[2, k], 0], [0, 0, 1]])
        np.testing.assert_allclose(found.rotation[k].as_matrix(), z @ y @ x, atol=1e-12)
    arrays["attitude"] = found.rotation.as_quat()
    assert_same(converted(Log(**arrays), "a", SETTINGS), found)


def test_units_are_converted(arrays):
    expected = converted(Log(**arrays), "a", SETTINGS)
    units = Units(1e-3, 0.01, np.pi / 180, 1 / 3.6, 5.0, -0.5)
    other = {
        "time": arrays["time"] * 1e3,
        "position": arrays["position"] * 100,
        "attitude": np.degrees(arrays["attitude"]),
        "velocity": arrays["velocity"] * 3.6,
        "angular_velocity": np.degrees(arrays["angular_velocity"]),
        "command_time": arrays["command_time"] * 1e3,
        "command": arrays["command"] / [5, -0.5],
    }
    assert_same(converted(Log(**other), "a", replace(SETTINGS, units=units)), expected)


@pytest.mark.parametrize("as_quaternion", [False, True])
def test_frames_are_converted(arrays, as_quaternion):
    """North-east-down, with velocities in the world, and a world that begins elsewhere."""
    expected = converted(Log(**arrays), "a", SETTINGS)
    flip, origin = np.diag([1.0, -1, -1]), np.array([500.0, -300, 20])
    down = Rotation.from_matrix(flip @ expected.rotation.as_matrix() @ flip)
    frames = Frames("z_down", "world", "world", tuple(origin.tolist()))
    other = arrays | {
        "position": (arrays["position"] + origin) @ flip,
        "attitude": down.as_quat() if as_quaternion else down.as_euler("ZYX")[:, ::-1],
        "velocity": down.apply(arrays["velocity"] @ flip),
        "angular_velocity": down.apply(arrays["angular_velocity"] @ flip),
    }
    assert_same(converted(Log(**other), "a", replace(SETTINGS, frames=frames)), expected)


@pytest.mark.parametrize(
    ("field", "sample", "value", "message"),
    [
        ("time", 5, np.nan, "a.csv: time: expected finite numbers, found nan in sample 5"),
        ("time", 5, 0.0, r"a.csv: time: expected stamps that increase, found 0.0 in sample 5 "),
        ("command_time", 5, 0.0, "a.csv: time of commands: expected stamps that increase"),
        ("position", 7, np.inf, "a.csv: position: expected finite numbers, found .* in sample 7"),
        ("velocity", 0, np.nan, "a.csv: velocity: expected finite numbers"),
        ("command", 2, np.nan, "a.csv: command: expected finite numbers"),
        ("attitude", 3, 0.0, "a.csv: attitude: expected quaternions of length 1, found 0.0 in sam"),
    ],
)
def test_what_cannot_be_used_is_named(arrays, field, sample, value, message):
    quaternions = Rotation.from_euler("ZYX", arrays["attitude"][:, ::-1]).as_quat()
    arrays = {name: array.copy() for name, array in arrays.items()} | {"attitude": quaternions}
    arrays[field][sample] = value
    with pytest.raises(DataError, match=message) as error:
        converted(Log(**arrays), "a.csv", SETTINGS)
    assert "\n" not in str(error.value)


def test_stamps_that_repeat_are_refused(arrays):
    arrays["time"] = arrays["time"].copy()
    arrays["time"][8] = arrays["time"][7]
    with pytest.raises(DataError, match="expected stamps that increase"):
        converted(Log(**arrays), "a", SETTINGS)


def test_settings_of_no_vehicle():
    with pytest.raises(ValueError, match="track: expected more than 0, found 0"):
        VehicleSettings(wheelbase=1.0, track=0.0)
    with pytest.raises(ValueError, match="speed: expected how many SI units one unit is, found 0"):
        Units(speed=0.0)
    left_front = ImportSettings(VehicleSettings(2.0, 1.2)).vehicle.wheels_in_body_xy[0]
    assert left_front == [1.0, 0.6]
