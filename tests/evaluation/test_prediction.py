from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.evaluation import prediction
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.windows import Windows, cut
from vertiwm_jax.mechanics.kinematic import ConstantVelocity, KinematicBicycle, bicycle_of
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import hmmwv
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain import map as terrain_map

DRIVES = Path(__file__).parents[1] / "data" / "chrono_drives"
CONTEXT, HORIZON = 4, 6
GROUND = terrain_map.build(np.zeros((65, 65)), np.full((8, 8), 3))


def straight(windows: int = 5) -> Windows:
    """Straight drives at 1, 2, ... m/s, whose speed is commanded too."""
    steps = CONTEXT + HORIZON
    speed = 1.0 + jnp.arange(windows)[:, None]
    state = jnp.zeros((windows, steps + 1, 12))
    state = state.at[..., 0].set(0.1 * speed * jnp.arange(steps + 1)).at[..., 6].set(speed)
    control = jnp.zeros((windows, steps, 2)).at[..., 0].set(speed)
    world, ground = jnp.zeros(windows, jnp.int32), jnp.zeros(windows, jnp.int32)
    return Windows(state, control, world, ground, CONTEXT)


@dataclass(frozen=True)
class Recording:
    """Plays recorded states `[T, 12]`, its parameters, and adds `offset` m to what it predicts.

    It counts steps, so it is right only if the whole context was seen, once and in order.
    """

    offset: float = 0.0

    def init(self, params, terrain, state):
        return jnp.int32(0)

    def step(self, params, terrain, history, state, command):
        after = VehicleState.from_vector(params[history + 1])
        return replace(after, position=after.position + self.offset), history + 1


@dataclass(frozen=True)
class Faulty:
    """Constant velocity that is lost above a speed given as parameters."""

    def init(self, params, terrain, state):
        return ()

    def step(self, params, terrain, history, state, command):
        after, _ = ConstantVelocity().step(None, terrain, (), state, command)
        lost = state.velocity[0] > params
        return replace(after, position=jnp.where(lost, jnp.nan, after.position)), ()


def test_a_perfect_model_has_no_error():
    rng = np.random.default_rng(0)
    windows = straight(1)
    state = jnp.asarray(rng.normal(size=windows.state.shape), jnp.float32)
    windows = windows.replace(state=state)
    predicted = prediction.predict(Recording(), state[0], GROUND, windows)
    np.testing.assert_array_equal(predicted.vector[0], state[0, CONTEXT + 1 :])
    errors = prediction.evaluate("it", Recording(), state[0], GROUND, windows)
    assert errors.mean == {"rigid": 0.0}
    assert errors.diverged == 0


def test_the_error_is_the_distance_in_space_after_the_last_step():
    windows = straight(1)
    errors = prediction.evaluate("it", Recording(0.5), windows.state[0], GROUND, windows)
    assert errors.mean["rigid"] == pytest.approx(0.5 * np.sqrt(3), rel=1e-5)


def test_constant_velocity_is_right_on_straight_drives():
    errors = prediction.evaluate("it", ConstantVelocity(), None, GROUND, straight())
    assert errors.mean["rigid"] < 1e-5
    assert errors.count == {"rigid": 5}


def test_a_lost_model_counts_as_one_that_did_not_move():
    errors = prediction.evaluate("it", Faulty(), jnp.float32(3.5), GROUND, straight())
    assert errors.diverged == 2
    driven = 0.1 * HORIZON * np.array([0, 0, 0, 4, 5])
    assert errors.mean["rigid"] == pytest.approx(driven.mean(), rel=1e-4)
    assert errors.low["rigid"] < errors.mean["rigid"] < errors.high["rigid"]


def test_interval_covers_the_mean_as_often_as_it_says():
    rng = np.random.default_rng(0)
    bounds = np.array([prediction._bootstrap(rng.exponential(size=100)) for _ in range(300)])
    covered = ((bounds[:, 0] < 1) & (bounds[:, 1] > 1)).mean()
    assert 0.89 < covered < 0.99


def test_kinds_of_ground_are_apart():
    windows = straight(4).replace(ground=jnp.array([0, 2, 2, 0]))
    errors = prediction.evaluate("it", Faulty(), jnp.float32(0.0), GROUND, windows)
    assert errors.count == {"rigid": 2, "transition": 2}
    assert errors.mean["rigid"] == pytest.approx(0.6 * 2.5, rel=1e-4)
    assert errors.mean["transition"] == pytest.approx(0.6 * 2.5, rel=1e-4)


def test_table():
    windows = straight()
    rows = [
        prediction.evaluate("still", Faulty(), jnp.float32(0.0), GROUND, windows),
        prediction.evaluate("constant velocity", ConstantVelocity(), None, GROUND, windows),
    ]
    lines = prediction.format_table(rows, HORIZON).splitlines()
    assert lines[0].startswith("6-step position error, m")
    assert lines[2] == "| model | rigid (n = 5) | diverged |"
    assert lines[3] == "|---|---|---|"
    assert lines[4].startswith("| still | 1.800 (")
    assert lines[4].endswith(" | 5 |")
    assert lines[5] == "| constant velocity | 0.000 (0.000-0.000) | 0 |"


def test_the_built_in_simulator_beats_both_baselines_on_chrono_drives():
    drives, terrain = dataset.load(DRIVES, "train")
    windows = cut(drives, terrain, context=16, horizon=16, stride=16)
    vehicle = hmmwv()
    models = (
        (Simulator(), chrono_like(vehicle)),
        (KinematicBicycle(), bicycle_of(vehicle)),
        (ConstantVelocity(), None),
    )
    errors = []
    for model, params in models:
        final = prediction.predict(model, params, terrain, windows).position[:, -1]
        errors.append(float(jnp.linalg.norm(final - windows.state[:, -1, :3], axis=-1).mean()))
    simulator, bicycle, constant = errors
    assert jnp.isfinite(jnp.asarray(errors)).all()
    assert simulator < 0.35
    assert simulator < 0.7 * bicycle
    assert simulator < 0.7 * constant


def test_predictions_are_of_the_selected_worlds():
    rise = np.tile(0.2 * (np.arange(65) - 32.0), (65, 1)) + 8
    terrain = terrain_map.stack([GROUND, terrain_map.build(rise, np.full((8, 8), 3))])
    windows = straight(2).replace(world=jnp.array([0, 1]))
    final = prediction.predict(
        KinematicBicycle(), jax.tree.map(jnp.asarray, bicycle_of(hmmwv())), terrain, windows
    )
    assert float(final.rpy[0, -1, 1]) == pytest.approx(0.0, abs=1e-6)
    assert float(final.rpy[1, -1, 1]) == pytest.approx(-np.arctan(0.2), abs=1e-4)
