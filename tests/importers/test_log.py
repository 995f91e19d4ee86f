"""Units, frames and what is refused of a log."""

import re
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


def read(arrays, settings=SETTINGS):
    (log,) = converted(Log(**arrays), "a.csv", settings)
    return log


def assert_same(found, expected):
    for name in ("time", "position", "velocity", "angular_velocity", "command_time", "command"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-9)
    assert (found.rotation.inv() * expected.rotation).magnitude().max() < 1e-9


def test_roll_pitch_yaw_are_rz_ry_rx(arrays):
    found = read(arrays)
    c, s = np.cos(arrays["attitude"].T), np.sin(arrays["attitude"].T)
    for k in range(len(arrays["time"])):
        x = np.array([[1, 0, 0], [0, c[0, k], -s[0, k]], [0, s[0, k], c[0, k]]])
        y = np.array([[c[1, k], 0, s[1, k]], [0, 1, 0], [-s[1, k], 0, c[1, k]]])
        z = np.array([[c[2, k], -s[2, k], 0], [s[2, k], c[2, k], 0], [0, 0, 1]])
        np.testing.assert_allclose(found.rotation[k].as_matrix(), z @ y @ x, atol=1e-12)
    arrays["attitude"] = found.rotation.as_quat()
    assert_same(read(arrays), found)


def test_units_are_converted(arrays):
    expected = read(arrays)
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
    assert_same(read(other, replace(SETTINGS, units=units)), expected)


@pytest.mark.parametrize("as_quaternion", [False, True])
def test_frames_are_converted(arrays, as_quaternion):
    """North-east-down, with velocities in the world, and a world that begins elsewhere."""
    expected = read(arrays)
    flip, origin = np.diag([1.0, -1, -1]), np.array([500.0, -300, 20])
    down = Rotation.from_matrix(flip @ expected.rotation.as_matrix() @ flip)
    frames = Frames("z_down", "world", "world", tuple(origin.tolist()))
    other = arrays | {
        "position": (arrays["position"] + origin) @ flip,
        "attitude": down.as_quat() if as_quaternion else down.as_euler("ZYX")[:, ::-1],
        "velocity": down.apply(arrays["velocity"] @ flip),
        "angular_velocity": down.apply(arrays["angular_velocity"] @ flip),
    }
    assert_same(read(other, replace(SETTINGS, frames=frames)), expected)


WRONG = {
    "time": (np.nan, "time: expected finite numbers, found nan"),
    "command_time": (np.nan, "time of commands: expected finite numbers"),
    "position": (np.inf, "position: expected finite numbers, found .*inf"),
    "velocity": (np.nan, "velocity: expected finite numbers"),
    "command": (np.nan, "command: expected finite numbers"),
    "attitude": (0.0, "attitude: expected quaternions of length 1, found 0.0"),
}


def with_wrong(arrays, field, samples):
    quaternions = Rotation.from_euler("ZYX", arrays["attitude"][:, ::-1]).as_quat()
    arrays = {name: array.copy() for name, array in arrays.items()} | {"attitude": quaternions}
    arrays[field][samples] = WRONG[field][0]
    return arrays


@pytest.mark.parametrize("field", WRONG)
def test_samples_that_cannot_be_used_are_left_out_and_said(arrays, field):
    log = read(with_wrong(arrays, field, [5, 9]))
    of_commands = field.startswith("command")
    time, whole = (log.command_time, log.time) if of_commands else (log.time, log.command_time)
    np.testing.assert_allclose(time, np.delete(arrays["time"], [5, 9]))
    np.testing.assert_allclose(whole, arrays["time"])
    (remark,) = log.remarks
    assert re.match(f"a.csv: {WRONG[field][1]}", remark)
    assert "in sample 5 among 2 such" in remark and log.remarks[remark] == 2
    assert remark.endswith(f"{arrays['time'][4]:.13g} and {arrays['time'][6]:.13g}: left out")


@pytest.mark.parametrize("field", WRONG)
def test_a_log_of_which_most_cannot_be_used_is_refused(arrays, field):
    wrong = with_wrong(arrays, field, np.s_[3:])
    with pytest.raises(DataError, match=f"a.csv: {WRONG[field][1]}.* in sample 3 ") as error:
        read(wrong)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("field", ["time", "command_time"])
@pytest.mark.parametrize("stamp", [7, 3, 0])
def test_a_stamp_that_does_not_increase_is_left_out_and_said(arrays, field, stamp):
    arrays[field] = arrays[field].copy()
    arrays[field][8] = arrays[field][stamp]
    log = read(arrays)
    np.testing.assert_allclose(getattr(log, field), np.delete(arrays[field], 8))
    (remark,) = log.remarks
    assert "expected stamps that increase" in remark


def test_two_stamps_that_are_swapped_cost_one_sample(arrays):
    arrays["time"] = arrays["time"].copy()
    arrays["time"][[8, 9]] = arrays["time"][[9, 8]]
    log = read(arrays)
    np.testing.assert_allclose(log.time, np.delete(arrays["time"], 9))


def test_a_clock_that_is_set_back_cuts_the_log(arrays):
    twice = {name: np.concatenate([array, array]) for name, array in arrays.items()}
    logs = converted(Log(**twice), "a.csv", SETTINGS)
    for log in logs:
        assert_same(log, read(arrays))
    assert len(logs) == 2
    said = f"is set back from {arrays['time'][-1]:.13g} to {arrays['time'][0]:.13g}"
    assert [said in remark for remark in logs[0].remarks] == [True, True]
    with pytest.raises(DataError, match=r"expected clocks .* set back together, found 1 and 0"):
        converted(Log(**twice | {k: arrays[k] for k in ("command_time", "command")}), "a", SETTINGS)


def test_settings_of_no_vehicle():
    with pytest.raises(ValueError, match="track: expected more than 0, found 0"):
        VehicleSettings(wheelbase=1.0, track=0.0)
    with pytest.raises(ValueError, match="speed: expected how many SI units one unit is, found 0"):
        Units(speed=0.0)
    left_front = ImportSettings(VehicleSettings(2.0, 1.2)).vehicle.wheels_in_body_xy[0]
    assert left_front == [1.0, 0.6]


def test_commands_may_be_moved_later(arrays):
    later = replace(SETTINGS.resampling, delay=0.25)
    vehicle = replace(SETTINGS.vehicle, scale=4.0)
    found = read(arrays, replace(SETTINGS, resampling=later, vehicle=vehicle))
    # Times of the vehicle's own are half of those at full size.
    np.testing.assert_allclose(found.command_time - found.time, 0.5)
