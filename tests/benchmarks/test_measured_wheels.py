"""The fitted wheels stay as close to the measured trials as docs/results.md says."""

import jax
import numpy as np
import pytest

from benchmarks import measured_wheels
from benchmarks.measured_wheels import WHEELS, WITHOUT, errors, predicted


@pytest.fixture(scope="module")
def trials():
    return measured_wheels.read(measured_wheels.TRIALS)


def median(got, measured):
    return 100 * np.nanmedian(errors(np.asarray(got), measured), axis=0)


@pytest.mark.parametrize("name", WHEELS)
def test_fitted_wheels_are_within_bands_of_all_trials(trials, name):
    wheel, fitted = WHEELS[name]
    of, predict = trials[name], jax.jit(predicted)
    assert len(of.load) == 135
    got = median(predict(wheel, *fitted, of), of.measured)
    assert (got < [18, 14, 12]).all(), got
    inside = of.slip_angle < 90
    got = median(predict(wheel, *fitted, of)[inside], of.measured[inside])
    assert (got < [15, 13, 12]).all(), got
    before = median(predict(wheel, *WITHOUT, of), of.measured)
    assert (before > [50, 55, 40]).all(), before


def test_errors_leave_out_what_was_hardly_measured():
    measured = np.array([[2.0, 0.5, 10.0], [-4.0, -8.0, 20.0]])
    got = errors(np.array([[1.0, 5.0, 12.0], [-4.0, 8.0, 20.0]]), measured)
    np.testing.assert_allclose(got, [[0.5, np.nan, 0.2], [0, 2, 0]], atol=1e-12)


def test_repetitions_are_the_mean_of_the_others(trials):
    of = trials["smooth"]
    same = (of.slip_angle == 45) & (np.abs(of.slip - 0.5) < 0.02)
    got, measured = measured_wheels.repeated(of)[same], of.measured[same]
    assert len(measured) == 3
    np.testing.assert_allclose(got, (measured.sum(axis=0) - measured) / 2)


@pytest.mark.integration
def test_a_slip_angle_that_was_left_out_is_predicted(trials):
    wheel, of = WHEELS["smooth"][0], trials["smooth"]
    out = of.slip_angle == 45
    fitted = measured_wheels.fitter(wheel, of)(~out)
    got = median(jax.jit(predicted)(wheel, *fitted, of)[out], of.measured[out])
    assert (got < [15, 10, 13]).all(), got
