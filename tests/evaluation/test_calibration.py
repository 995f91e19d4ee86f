"""Bounds on errors, on errors whose size is known, and on predictions whose errors are."""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from vertiwm_jax.evaluation import calibration
from vertiwm_jax.evaluation.calibration import LEVELS, Calibration
from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.terrain.map import TerrainMap


def errors(seed, count=40_000):
    """Errors, m, of a size that grows with the disagreement, and the disagreements."""
    random = np.random.default_rng(seed)
    disagreement = random.uniform(0.01, 0.05, count)
    return (0.02 + 4 * disagreement) * random.exponential(size=count), disagreement


def constant(error):
    """One bound for all disagreements."""
    return Calibration.measure(error, np.zeros_like(error))


def covered(bounds, error, disagreement, order=None):
    """For each level: it, how often its bound holds, and how often in each part."""
    given = {"order": disagreement if order is None else order, "it": disagreement}
    rows = calibration.coverage({"it": bounds}, error, given)
    assert [row["bound for"] for row in rows] == ["50%", "80%", "90%", "95%"]
    return [
        (level, share(row["held for"]), [share(part) for part in row["by part"].split(" / ")])
        for level, row in zip(LEVELS, rows, strict=True)
    ]


def share(text):
    return float(text.rstrip("%")) / 100


def test_bounds_hold_as_often_as_they_say_at_every_disagreement():
    found = Calibration.measure(*errors(0))
    np.testing.assert_allclose(found.line, [4.0, 0.02], rtol=0.25)
    error, disagreement = errors(1)
    for level, held, parts in covered(found, error, disagreement):
        np.testing.assert_allclose(parts, level, atol=0.05)
        assert held == pytest.approx(level, abs=0.02)


def test_the_quantiles_of_exponential_errors():
    found = Calibration.measure(*errors(0))
    for level in LEVELS:
        expected = -np.log(1 - level) * (0.02 + 4 * 0.03)
        assert found.bound(np.array([0.03]), level)[0] == pytest.approx(expected, rel=0.1)


def test_one_bound_for_all_holds_too_often_where_there_is_least_disagreement():
    found = constant(errors(0)[0])
    for level, held, parts in covered(found, *errors(1)):
        assert held == pytest.approx(level, abs=0.02)
        assert parts[0] > level > parts[-1]


def test_parts_are_fifths_in_the_order_of_disagreement():
    disagreement = np.array([5.0, 1.0, 4.0, 2.0, 3.0])
    rows = calibration.parts(10 * disagreement, disagreement)
    assert [float(row["mean error, m"]) for row in rows] == [10, 20, 30, 40, 50]


def test_the_picture_has_every_bound_and_how_often_it_held():
    (error, disagreement), tested = errors(0), errors(1, count=500)
    known = Calibration.measure(error, disagreement)
    left, right = calibration.picture(known, *tested, constant(error)).axes
    drawn = {line.get_label(): line.get_xydata() for line in left.lines}
    place, bound = drawn["bound for 90%"].T
    np.testing.assert_allclose(bound, known.bound(place, 0.9))
    held = {line.get_label(): line.get_xydata() for line in right.lines}
    level, share = held["from disagreement, where it is most"].T
    np.testing.assert_allclose(share, level, atol=0.12)
    level, share = held["not from disagreement, where it is most"].T
    assert np.max(level - share) > 0.12


def test_parts_can_be_ordered_by_something_else():
    error, disagreement = errors(0)
    found = Calibration.measure(error, disagreement)
    _, held, parts = covered(found, error, disagreement, order=error)[1]
    assert parts[0] == 1.0 and parts[-1] < 0.5
    assert held == pytest.approx(0.8, abs=0.01)


@struct.dataclass
class Step:
    count: object
    disagreement: object
    spread: object


@dataclass(frozen=True)
class Standing:
    """Never moves; its specialists disagree in the fifth step and after, its gates by half of it.

    gates: whether there are several.
    """

    gates: bool = True

    def init(self, params, terrain, state):
        return Step(jnp.int32(0), jnp.float32(0), jnp.float32(0))

    def step(self, params, terrain, history, state, command):
        count = history.count + 1
        apart = jnp.where(count >= 5, params, jnp.float32(0))
        state = replace(state, position=state.position + 0 * params)
        return state, Step(count, apart, apart / 2 if self.gates else jnp.float32(0))


def standing(windows=3, context=2, horizon=4):
    """Windows of vehicles that drive 1, 2, ... m in the last step."""
    state = np.zeros((windows, context + horizon + 1, 12), np.float32)
    state[:, -1, 0] = 1 + np.arange(windows)
    control = np.zeros((windows, context + horizon, 2), np.float32)
    none = np.zeros(windows, np.int32)
    ground = TerrainMap.from_array(np.zeros((65, 65)), np.full((8, 8), 3))
    arrays = (jnp.asarray(x) for x in (state, control, none, none))
    return TestWindows(Windows(*arrays, context), none, ground)


def test_errors_and_disagreement_are_those_of_the_predicted_steps():
    """Two of the context, and four predicted, in the last two of which they disagree."""
    error, found = calibration.signs(Standing(), jnp.float32(0.25), standing())
    np.testing.assert_allclose(error, [1, 2, 3], rtol=1e-6)
    assert list(found) == ["gates", "specialists", "nothing"]
    np.testing.assert_allclose(found["gates"], 0.25)
    np.testing.assert_allclose(found["specialists"], 0.5)


def test_a_single_gate_tells_nothing():
    _, found = calibration.signs(Standing(gates=False), jnp.float32(0.25), standing())
    assert list(found) == ["specialists", "nothing"]


def test_a_prediction_that_is_not_finite_is_an_error():
    with pytest.raises(ValueError, match="found 3 of 3 that are not"):
        calibration.signs(Standing(), jnp.float32(np.nan), standing())
