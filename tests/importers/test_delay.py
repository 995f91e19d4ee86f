"""The delay of commands, against drives that were made with one."""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from vertiwm_jax.importers import delay
from vertiwm_jax.importers.delay import Response

FINE = 0.001


def response(late, lags=(0.3, 0.1), seconds=60.0, noise=0.05, window=0.0, seed=0):
    """Speed and yaw rate follow sudden commands; as slopes of parabolas over a window, if any."""
    rng = np.random.default_rng(seed)
    fine = np.arange(0, seconds, FINE)
    held = np.arange(0, seconds, 0.4)
    command = rng.uniform([0.5, -0.4], [4.0, 0.4], (len(held), 2))
    told = command[np.maximum(np.searchsorted(held, fine - late, side="right") - 1, 0)]
    target = np.stack([told[:, 0], np.tan(told[:, 1]) / 2.0], 1)
    found = np.zeros_like(target)
    for k in range(1, len(fine)):
        found[k] = found[k - 1] + (target[k - 1] - found[k - 1]) * FINE / np.array(lags)
    speed, yaw_rate = found[:, 0], 0.9 * found[:, 0] * found[:, 1]
    time = np.arange(1.0, seconds - 1, 0.1)
    motion = []
    for values in (speed, yaw_rate):
        if window:
            way = cumulative_trapezoid(values, fine, initial=0)
            near = [np.abs(fine - at) <= window / 2 for at in time]
            fits = [np.polyfit(fine[n] - at, way[n], 2) for n, at in zip(near, time, strict=True)]
            motion.append(np.array(fits)[:, 1])
        else:
            motion.append(np.interp(time, fine, values))
        motion[-1] = motion[-1] + noise * motion[-1].std() * rng.normal(size=len(time))
    return Response(time, *motion, held, command)


@pytest.mark.parametrize("late", [0.0, 0.03, 0.1, 0.25])
@pytest.mark.parametrize("window", [0.0, 0.5])
def test_a_delay_is_found_beside_the_lags(late, window):
    found = delay.estimate([response(late, window=window)], window)
    assert found is not None
    assert found.seconds == pytest.approx(late, abs=0.02)
    assert found.low - 0.011 <= late <= found.high + 0.011 and found.high - found.low < 0.1
    assert found.lags == (pytest.approx(0.3, abs=0.1), pytest.approx(0.1, abs=0.06))


def test_drives_together_tell_it_more_exactly():
    drives = [response(0.12, seconds=12.0, noise=0.3, seed=seed) for seed in range(8)]
    (one, all_) = delay.estimate(drives[:1]), delay.estimate(drives)
    assert all_ is not None and all_.seconds == pytest.approx(0.12, abs=0.02)
    assert one is None or all_.high - all_.low < one.high - one.low


def test_steering_alone_tells_it():
    turning = response(0.1)
    steady = np.full(len(turning.command), 2.0)
    drive = Response(
        turning.time,
        np.full(len(turning.time), 2.0),
        2.0 * turning.yaw_rate / turning.speed,
        turning.command_time,
        np.column_stack([steady, turning.command[:, 1]]),
    )
    found = delay.estimate([drive])
    assert found is not None and found.lags[0] is None
    assert found.seconds == pytest.approx(0.1, abs=0.02)


def test_what_does_not_follow_commands_has_no_delay():
    drive, other = response(0.1), response(0.1, seed=1)
    unrelated = Response(drive.time, drive.speed, drive.yaw_rate, other.command_time, other.command)
    assert delay.estimate([unrelated]) is None
    still = Response(
        drive.time, 0 * drive.speed, 0 * drive.speed, drive.command_time, drive.command
    )
    assert delay.estimate([still]) is None
    never = Response(drive.time, drive.speed, drive.yaw_rate, drive.command_time, 0 * drive.command)
    assert delay.estimate([never]) is None
