"""Bounds on errors, on errors whose size is known, and on predictions whose errors are."""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from vertiwm_jax.evaluation import calibration
from vertiwm_jax.evaluation.calibration import LEVELS, Calibration, Signs
from vertiwm_jax.evaluation.prediction import TestWindows, predict
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.terrain.map import TerrainMap


def errors(seed, count=40_000):
    """Errors, m, of a size that grows with the disagreement, and that, `[count, 1]`."""
    random = np.random.default_rng(seed)
    disagreement = random.uniform(0.01, 0.05, count)
    return (0.02 + 4 * disagreement) * random.exponential(size=count), disagreement[:, None]


def signs(seed, count=40_000, unit=0):
    """`errors` of drives of ten windows each, in one world by one vehicle."""
    error, disagreement = errors(seed, count)
    shown = {"gates": disagreement, "nothing": np.empty((count, 0))}
    number = np.full(count, unit)
    return Signs(error, shown, np.arange(count) // 10, number, number.astype(str))


def covered(folds, name="gates"):
    """For each level: it, how often its bound holds, and how often in each part."""
    rows = [row for row in calibration.coverage(folds) if row["found from"] == name]
    assert [row["bound for"] for row in rows] == ["50%", "80%", "90%", "95%"]
    return [
        (level, share(row["held for"]), [share(part) for part in row["by part"].split(" / ")])
        for level, row in zip(LEVELS, rows, strict=True)
    ]


def share(text):
    return float(text.split("%")[0]) / 100


def test_bounds_hold_as_often_as_they_say_at_every_disagreement():
    found = Calibration.measure(*errors(0))
    np.testing.assert_allclose(found.weights, [0.02, 4.0], rtol=0.25)
    for level, held, parts in covered([(signs(0), signs(1))]):
        np.testing.assert_allclose(parts, level, atol=0.05)
        assert held == pytest.approx(level, abs=0.02)


def test_the_quantiles_of_exponential_errors():
    found = Calibration.measure(*errors(0))
    for level in LEVELS:
        expected = -np.log(1 - level) * (0.02 + 4 * 0.03)
        assert found.bound(np.array([[0.03]]), level)[0] == pytest.approx(expected, rel=0.1)


def test_one_bound_for_all_holds_too_often_where_there_is_least_disagreement():
    for level, held, parts in covered([(signs(0), signs(1))], "nothing"):
        assert held == pytest.approx(level, abs=0.02)
        assert parts[0] > level > parts[-1]


def test_parts_are_fifths_in_the_order_of_what_is_expected():
    expected = np.array([5.0, 1.0, 4.0, 2.0, 3.0])
    rows = calibration.parts(10 * expected, expected)
    assert [float(row["mean error, m"]) for row in rows] == [10, 20, 30, 40, 50]


def test_the_picture_has_every_bound_and_how_often_it_held():
    known = Calibration.measure(*errors(0))
    left, right = calibration.picture([(signs(0), signs(1, count=500))]).axes
    drawn = {line.get_label(): line.get_xydata() for line in left.lines}
    place, bound = drawn["bound for 90%"].T
    np.testing.assert_allclose(bound, known.quantile(0.9) * place)
    held = {line.get_label(): line.get_xydata() for line in right.lines}
    level, share = held["from gates, large expected errors"].T
    np.testing.assert_allclose(share, level, atol=0.12)
    level, share = held["constant, large expected errors"].T
    assert np.max(level - share) > 0.12


def test_each_world_is_tried_with_bounds_from_the_others():
    """Where errors of one are three times as large, its bounds hold too seldom."""
    usual, worse = signs(0, 5_000), signs(1, 5_000, unit=1)
    worse = replace(worse, error=3 * worse.error, drive=worse.drive + 1_000)
    shown = {name: np.append(x, worse.shown[name], axis=0) for name, x in usual.shown.items()}
    own = (np.append(getattr(usual, x), getattr(worse, x)) for x in ("drive", "world", "vehicle"))
    every = Signs(np.append(usual.error, worse.error), shown, *own)
    for by in ("worlds", "vehicles"):
        folds = every.folds(by)
        assert [len(tried.error) for _, tried in folds] == [5_000, 5_000]
        (_, easy, _), (_, hard, _) = (covered([fold])[2] for fold in folds)
        assert easy > 0.99 and hard < 0.6
        _, both, _ = covered(folds)[2]
        assert both == pytest.approx((easy + hard) / 2, abs=1e-3)
    with pytest.raises(DataError, match="expected drives of two worlds or more, found of 1"):
        usual.folds("worlds")


def test_intervals_of_shares_are_over_drives():
    """Windows of a drive that err alike count as one."""
    alike = signs(1, 4_000)
    first = alike.drive * 10
    shown = {name: x[first] for name, x in alike.shown.items()}
    alike = replace(alike, error=alike.error[first], shown=shown)
    wide, narrow = (
        [float(x.rstrip("%)")) for x in row["held for"].split("(")[1].split("-")]
        for row in (calibration.coverage([(signs(0), x)])[4] for x in (alike, signs(1, 4_000)))
    )
    assert 2 < (wide[1] - wide[0]) / (narrow[1] - narrow[0]) < 5


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
    """Windows of vehicles that drive 1, 2, ... m in the last step, and are told to drive 5 m/s."""
    state = np.zeros((windows, context + horizon + 1, 12), np.float32)
    state[:, -1, 0] = 1 + np.arange(windows)
    control = np.full((windows, context + horizon, 2), (-5, 0), np.float32)
    none = np.zeros(windows, np.int32)
    ground = TerrainMap.from_array(np.zeros((65, 65)), np.full((8, 8), 3))
    arrays = (jnp.asarray(x) for x in (state, control, none, none))
    return TestWindows(Windows(*arrays, context), none, ground)


def shown(dynamics, apart):
    test = standing()
    return Signs.of(predict(dynamics, jnp.float32(apart), test), test)


def test_errors_and_signs_are_those_of_the_predicted_steps():
    """Two of the context, and four predicted, in the last two of which they disagree."""
    found = shown(Standing(), 0.25)
    np.testing.assert_allclose(found.error, [1, 2, 3], rtol=1e-6)
    assert list(found.shown) == ["gates and lag", "gates", "lag", "specialists", "nothing"]
    np.testing.assert_allclose(found.shown["gates and lag"], [[0.25, 2.0]] * 3)
    np.testing.assert_allclose(found.shown["gates"], [[0.25]] * 3)
    np.testing.assert_allclose(found.shown["lag"], [[2.0]] * 3)
    np.testing.assert_allclose(found.shown["specialists"], [[0.5]] * 3)
    assert found.shown["nothing"].shape == (3, 0)


def test_a_single_gate_shows_nothing():
    found = shown(Standing(gates=False), 0.25)
    assert list(found.shown) == ["lag", "specialists", "nothing"]


def test_several_signs_are_weighed_by_what_they_tell():
    """Errors three times the first sign and twice the second are expected so."""
    signs = np.random.default_rng(0).uniform(0.1, 1, (1_000, 2))
    found = Calibration.measure(signs @ (3.0, 2.0) + 0.5, signs)
    np.testing.assert_allclose(found.weights, [0.5, 3, 2], rtol=1e-6)
    np.testing.assert_allclose(found.bound(signs, 0.5), signs @ (3.0, 2.0) + 0.5, rtol=1e-6)


def test_a_prediction_that_is_not_finite_is_an_error():
    with pytest.raises(ValueError, match="found 3 of 3 that are not"):
        shown(Standing(), np.nan)
