import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.evaluation import prediction, yardsticks
from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain.map import TerrainMap

CONTEXT, HORIZON = 2, 10
LEVEL = np.zeros((65, 65)), np.full((8, 8), 3)
KEYS = [
    "model",
    "vehicle",
    "subset",
    "split",
    "speed_bin",
    "horizon",
    "windows",
    "position_m",
    "position_m_low",
    "position_m_high",
    "share_of_way",
    "heading_rad",
    "tilt_rad",
    "speed_m_s",
    "beyond_10_percent",
]
SPEEDS = (-3.0, -0.5, 0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 9.0)


def driven(speeds=SPEEDS, world=0, vehicles=()):
    """Straight windows of one drive each, at the speeds told in m/s."""
    steps, count = CONTEXT + HORIZON, len(speeds)
    speed = jnp.array(speeds)[:, None]
    state = jnp.zeros((count, steps + 1, 12))
    state = state.at[..., 0].set(0.1 * speed * jnp.arange(steps + 1)).at[..., 6].set(speed)
    control, none = jnp.zeros((count, steps, 2)), jnp.zeros(count, jnp.int32)
    windows = Windows(state, control, none + jnp.array(world), none, CONTEXT)
    return TestWindows(windows, np.arange(count), TerrainMap.from_array(*LEVEL), vehicles)


def off_by(test, *errors):
    """What was recorded, but that far to the left, m."""
    state = test.windows.state[:, CONTEXT + 1 :]
    return VehicleState.from_vector(state.at[..., 1].add(jnp.array(errors)[:, None]))


def found(test, predicted, **wanted):
    rows = yardsticks.rows("it", predicted, test, "test")
    wanted = {"vehicle": "unnamed", "subset": "all", "speed_bin": None} | wanted
    (row,) = [row for row in rows if all(getattr(row, k) == v for k, v in wanted.items())]
    return row


def test_windows_are_told_apart_by_their_mean_speed():
    test = driven()
    bins = {speed: of for _, ground, speed, of in yardsticks.groups(test) if ground == "all"}
    speeds = {name: np.array(SPEEDS)[of].tolist() for name, of in bins.items()}
    assert speeds == {
        None: list(SPEEDS),
        "below -0.5": [-3.0],
        "0.5-2": [0.5, 1.0],
        "2-4": [2.0, 3.0],
        "4-6": [5.0],
        "6-8": [7.0],
    }
    # It is the mean over the predicted steps, with its sign, that counts.
    state = test.windows.state.at[:, : CONTEXT + 1, 6].set(20.0)
    state = state.at[4, CONTEXT + 1 :, 6].set(jnp.where(jnp.arange(HORIZON) < 5, 3.0, -3.0))
    other = replace(test, windows=test.windows.replace(state=state))
    bins = {speed: of for _, ground, speed, of in yardsticks.groups(other) if ground == "all"}
    assert np.array(SPEEDS)[bins["0.5-2"]].tolist() == [0.5]


def test_the_share_of_the_way_is_the_mean_error_over_the_mean_way():
    test = driven((1.0, 3.0, 5.0))  # 1, 3 and 5 m; the first is too short to count
    row = found(test, off_by(test, 0.9, 0.2, 0.6))
    assert row.position_m == pytest.approx((0.9 + 0.2 + 0.6) / 3, rel=1e-5)
    assert row.share_of_way == pytest.approx((0.2 + 0.6) / (3 + 5), rel=1e-5)
    assert row.beyond_10_percent == 0.5
    assert row.horizon == HORIZON and row.windows == 3 and row.diverged == 0
    assert found(test, off_by(test, 0.9, 0.2, 0.6), speed_bin="0.5-2").share_of_way is None


def test_the_way_is_along_the_path():
    test = driven((3.0, 3.0))
    there_and_back = jnp.array([0.0, 1, 2, 3, 4, 5, 4, 3, 2, 1, 0]) * 0.3
    state = test.windows.state.at[:, CONTEXT:, 0].set(there_and_back)
    test = replace(test, windows=test.windows.replace(state=state))
    assert found(test, off_by(test, 0.3, 0.3)).share_of_way == pytest.approx(0.1, rel=1e-5)


def test_quantiles_and_intervals():
    errors = np.linspace(0.1, 1.0, 10)
    test = driven([3.0] * 10)
    row = found(test, off_by(test, *errors))
    assert row.position_m_median == pytest.approx(np.median(errors), rel=1e-5)
    assert row.position_m_90_percent == pytest.approx(np.quantile(errors, 0.9), rel=1e-5)
    assert row.position_m_99_percent == pytest.approx(np.quantile(errors, 0.99), rel=1e-5)
    interval = prediction.bootstrap(np.float32(errors), np.arange(10))
    assert (row.position_m_low, row.position_m_high) == pytest.approx((interval.low, interval.high))
    assert row.position_m_low < 0.5 < row.position_m_high


def test_vehicles_are_told_apart_where_there_are_several():
    test = driven((1.0, 3.0, 5.0), world=(0, 1, 0), vehicles=("uaz", "rover"))
    predicted = off_by(test, 0.1, 0.2, 0.3)
    rows = yardsticks.rows("it", predicted, test, "test")
    assert {row.vehicle for row in rows} == {"all", "uaz", "rover"}
    assert found(test, predicted, vehicle="uaz").position_m == pytest.approx(0.2, rel=1e-5)
    assert found(test, predicted, vehicle="rover", speed_bin="2-4").windows == 1
    assert found(test, predicted, vehicle="all").windows == 3
    alone = driven((1.0, 3.0), vehicles=("uaz",))
    rows = yardsticks.rows("it", off_by(alone, 0.1, 0.2), alone, "test")
    assert {row.vehicle for row in rows} == {"uaz"}


def test_grounds_are_told_apart_with_their_speeds():
    test = driven((1.0, 3.0, 3.0))
    test = replace(test, windows=test.windows.replace(ground=jnp.array([1, 1, 0])))
    predicted = off_by(test, 0.1, 0.2, 0.3)
    assert found(test, predicted, subset="rigid").position_m == pytest.approx(0.3, rel=1e-5)
    soft = found(test, predicted, subset="deformable", speed_bin="2-4")
    assert soft.position_m == pytest.approx(0.2, rel=1e-5) and soft.windows == 1


def test_json_has_these_keys_and_the_values_of_the_rows():
    test = driven((0.2, 3.0))
    rows = yardsticks.rows("it", off_by(test, 0.1, 0.2), test, "validation")
    told = json.loads(yardsticks.json_text(rows))
    assert len(told) == len(rows) == 4  # all windows and those of one bin, each also as rigid
    for one, row in zip(told, rows, strict=True):
        assert list(one) == KEYS
        assert one == {key: getattr(row, key) for key in KEYS}
    assert told[0]["split"] == "validation" and told[0]["speed_bin"] is None
    short = driven((0.2,))
    (lone, _) = json.loads(
        yardsticks.json_text(yardsticks.rows("it", off_by(short, 0.1), short, "test"))
    )
    assert lone["share_of_way"] is None and lone["beyond_10_percent"] is None


def test_a_table_has_every_model_in_every_group():
    test = driven((1.0, 3.0, 5.0), world=(0, 1, 0), vehicles=("uaz", "rover"))
    rows = [
        row
        for name, error in (("good", 0.1), ("bad", 0.5))
        for row in yardsticks.rows(name, off_by(test, *[error] * 3), test, "test")
    ]
    title, _, head, _, *body = yardsticks.table(rows).splitlines()
    assert title.startswith("Errors after 10 steps (1 s)")
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in (head, *body)]
    assert [cells[0][0], cells[0][1], cells[0][4]] == ["windows", "model", "of the way"]
    assert [row[:2] for row in cells[1:]] == [
        [group, model]
        for group in (
            "all (n = 3)",
            "rigid (n = 3)",
            "rover (n = 1)",
            "uaz (n = 2)",
            "0.5-2 m/s (n = 1)",
            "2-4 m/s (n = 1)",
            "4-6 m/s (n = 1)",
        )
        for model in ("good", "bad")
    ]
    assert cells[2][2].startswith("0.500 (0.500-0.500)") and cells[2][4] == "12.5 %"
    assert cells[9][4] == ""
