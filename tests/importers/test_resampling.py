"""Logs at irregular moments to drives at 10 Hz: against a drive that is known at every moment."""

from dataclasses import replace

import numpy as np
import pytest
from importers.logged import SETTINGS, Logged, commands, errors, logged, rms

from vertiwm_jax.importers.log import Log, converted
from vertiwm_jax.importers.resampling import resample
from vertiwm_jax.importers.settings import Resampling

ORIGIN = np.zeros(3)
WHOLE = Resampling(longest=10_000)


def build(seen: Logged, rows=slice(None), with_velocities: bool = False, settings=SETTINGS):
    velocities = {}
    if with_velocities:
        velocities = {
            "velocity": seen.state[rows, 6:9],
            "angular_velocity": seen.state[rows, 9:12],
        }
    found = Log(
        time=seen.time[rows],
        position=seen.position[rows],
        attitude=seen.rotation.as_quat()[rows],
        command_time=seen.time[rows],
        command=seen.command[rows],
        **velocities,
    )
    (log,) = converted(found, "a.csv", settings)
    return log


def moments(seen: Logged, steps: int, first: int = 0) -> np.ndarray:
    return seen.time[first] + 0.1 * np.arange(steps + 1)


def test_logged_states_are_interpolated():
    seen = logged()
    (drive,) = resample(build(seen, with_velocities=True), WHOLE, ORIGIN)[0]
    steps = int((seen.time[-1] - seen.time[0]) / 0.1)
    assert drive.control.shape == (steps, 2) and drive.state.shape == (steps + 1, 12)
    # Linear interpolation errs by (0.06 s)^2 / 8 of the second derivative at most, here 0.7 / s2.
    error = errors(drive.state, moments(seen, steps))
    np.testing.assert_array_less(np.abs(error), 5e-4)


def test_a_command_holds_until_the_next():
    seen = logged()
    (drive,) = resample(build(seen), WHOLE, ORIGIN)[0]
    for at, control in zip(moments(seen, len(drive.control)), drive.control, strict=False):
        latest = seen.time[seen.time <= at + 1e-6][-1]
        np.testing.assert_allclose(control, commands(np.array([latest]))[0])


@pytest.mark.parametrize(
    ("rate", "noise", "window", "largest"),
    [
        # position m, angle rad, velocity m/s, angular velocity rad/s: root mean squares
        (50, 0, 0.5, (5e-5, 1e-5, 0.001, 0.0006)),
        (50, 1, 0.5, (0.010, 0.002, 0.025, 0.005)),
        (20, 1, 0.5, (0.010, 0.002, 0.040, 0.008)),
        (20, 1, 1.0, (0.010, 0.002, 0.015, 0.0035)),
    ],
)
def test_velocities_are_those_of_the_poses(rate, noise, window, largest):
    seen = logged(rate=rate, noise=noise)
    settings = replace(WHOLE, window=window)
    (drive,) = resample(build(seen), settings, ORIGIN)[0]
    error = errors(drive.state, moments(seen, len(drive.control)))
    np.testing.assert_array_less(rms(error), largest)
    if noise:  # Differences of poses 0.1 s apart are far worse.
        assert np.std(np.diff(error[:, :3], axis=0) / 0.1) > 2.5 * largest[2]


@pytest.mark.parametrize("first", [0.0, 3.0, 7.0])
def test_poses_that_are_held_make_drives_of_two_seconds(first):
    """Registered at 10 Hz and logged at 20, as the windows of real robots are."""
    seen = logged(seconds=2, rate=20, even=True, start=first)
    held = np.arange(len(seen.time)) // 2 * 2
    seen = replace(seen, position=seen.position[held], rotation=seen.rotation[held])
    (drive,) = resample(build(seen), replace(WHOLE, shortest=16), ORIGIN)[0]
    assert len(drive.control) == 19
    # Half of the poses are 0.05 s old, at about 3 m/s and 0.5 rad/s.
    error = errors(drive.state, moments(seen, 19))
    np.testing.assert_array_less(rms(error), (0.08, 0.012, 0.15, 0.06))
    np.testing.assert_array_less(np.abs(error[:, 6].mean()), 0.05)


def test_dropped_samples_cost_accuracy_and_no_more():
    seen = logged(noise=1)
    kept = np.ones(len(seen.time), bool)
    hole = (seen.time > 105) & (seen.time < 105.4)
    kept[hole] = False
    (drive,) = resample(build(seen, kept), WHOLE, ORIGIN)[0]
    error = errors(drive.state, moments(seen, len(drive.control)))
    near = np.abs(moments(seen, len(drive.control)) - 105.2) < 0.5
    assert np.abs(error[near, :3]).max() < 0.05 and np.abs(error[near, 6:9]).max() < 0.15
    assert rms(error)[2] < 0.03


def test_gaps_end_a_drive():
    seen = logged()
    kept = ~((seen.time > 105) & (seen.time < 105.6)) & ~((seen.time > 108) & (seen.time < 119.0))
    drives, left_out = resample(build(seen, kept), WHOLE, ORIGIN)
    assert [len(drive.control) for drive in drives] == [49]
    first, second = left_out["shorter than 32 steps"]
    assert first == pytest.approx(105.6, abs=0.03) and second == pytest.approx(119.0, abs=0.03)
    wide = replace(WHOLE, gap=0.7, command_gap=0.7)
    assert [len(d.control) for d in resample(build(seen, kept), wide, ORIGIN)[0]] == [79]


def test_drives_need_poses_and_commands():
    seen = logged()
    late = seen.time > 110
    found = Log(
        time=seen.time,
        position=seen.position,
        attitude=seen.rotation.as_quat(),
        command_time=seen.time[late],
        command=seen.command[late],
    )
    (found,) = converted(found, "a.bag", SETTINGS)
    (drive,) = resample(found, WHOLE, ORIGIN)[0]
    start = seen.time[late][0]
    at = start + 0.1 * np.arange(len(drive.control) + 1)
    assert np.abs(errors(drive.state, at)).max() < 0.02
    # Half a second after the last command nobody knows what was commanded.
    early = replace(found, command_time=seen.time[~late], command=seen.command[~late])
    (drive,) = resample(early, WHOLE, ORIGIN)[0]
    assert len(drive.control) == int((seen.time[~late][-1] + 0.5 - seen.time[0]) / 0.1)
    never = replace(found, command_time=seen.time[late] + 100)
    assert not resample(never, WHOLE, ORIGIN)[0]


def test_long_drives_are_cut():
    seen = logged()
    (whole,) = resample(build(seen), WHOLE, ORIGIN)[0]
    pieces = resample(build(seen), Resampling(longest=70), ORIGIN)[0]
    assert [len(piece.control) for piece in pieces] == [66, 66, 67]
    np.testing.assert_array_equal(
        np.concatenate([piece.control for piece in pieces]), whole.control
    )
    assert (pieces[0].state[-1] == pieces[1].state[0]).all()


def test_the_logged_point_may_lie_elsewhere():
    """A receiver on the roof moves by the turning of the vehicle too."""
    seen, mast = logged(), np.array([-0.5, 0.3, 1.2])
    seen.position = seen.position + seen.rotation.apply(mast)
    velocity = seen.state[:, 6:9] + np.cross(seen.state[:, 9:12], mast)
    for velocities in ({}, {"velocity": velocity, "angular_velocity": seen.state[:, 9:12]}):
        found = replace(build(seen), **velocities)
        (drive,) = resample(found, WHOLE, mast)[0]
        error = errors(drive.state, moments(seen, len(drive.control)))
        np.testing.assert_array_less(rms(error), (3e-4, 1e-4, 0.003, 0.003))


def test_settings_that_contradict_each_other():
    with pytest.raises(ValueError, match=r"shortest: expected .* half of longest"):
        Resampling(shortest=200, longest=250)
    with pytest.raises(ValueError, match="window: expected more than 0, found 0"):
        Resampling(window=0.0)
