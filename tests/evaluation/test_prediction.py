from dataclasses import dataclass, replace
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from scipy.spatial.transform import Rotation

from vertiwm_jax.dynamics import rollout
from vertiwm_jax.evaluation import error_sources, prediction
from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.dataset import Drives, WheelSignals
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.mechanics.kinematic import (
    ConstantVelocity,
    KinematicBicycle,
    bicycle_of,
    place,
)
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load, load_vehicle, stack
from vertiwm_jax.models.config import ModelConfig, with_soil
from vertiwm_jax.models.registry import moving
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model.alone import Alone

DRIVES = Path(__file__).parents[1] / "data" / "chrono_drives"
CONTEXT, HORIZON = 4, 6
GRASS, MUD = 3, terrain_map.STANDARD.names.index("mud")
GROUND = TerrainMap.from_array(np.zeros((65, 65)), np.full((8, 8), 3))


def straight(windows: int = 5) -> Windows:
    """Straight drives at 1, 2, ... m/s, whose speed is commanded too."""
    steps = CONTEXT + HORIZON
    speed = 1.0 + jnp.arange(windows)[:, None]
    state = jnp.zeros((windows, steps + 1, 12))
    state = state.at[..., 0].set(0.1 * speed * jnp.arange(steps + 1)).at[..., 6].set(speed)
    control = jnp.zeros((windows, steps, 2)).at[..., 0].set(speed)
    world, ground = jnp.zeros(windows, jnp.int32), jnp.zeros(windows, jnp.int32)
    return Windows(state, control, world, ground, CONTEXT)


def errors_of(model, params, windows, drive=None):
    drive = np.arange(len(windows.world)) if drive is None else drive
    test = TestWindows(windows, drive, GROUND)
    return prediction.summary("it", prediction.predict(model, params, test).states, test)


def means(errors, measure="position"):
    return {kind: interval.mean for kind, interval in errors.final[measure].items()}


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
    test = TestWindows(windows, np.zeros(1, int), GROUND)
    predicted = prediction.predict(Recording(), state[0], test).states
    np.testing.assert_array_equal(predicted.vector[0], state[0, CONTEXT + 1 :])
    errors = errors_of(Recording(), state[0], windows)
    assert all(means(errors, measure) == {"rigid": 0.0} for measure in errors.final)
    assert errors.diverged == 0


def test_the_error_is_the_distance_in_space_after_the_last_step():
    windows = straight(1)
    errors = errors_of(Recording(0.5), windows.state[0], windows)
    assert means(errors)["rigid"] == pytest.approx(0.5 * np.sqrt(3), rel=1e-5)
    assert means(errors, "horizontal")["rigid"] == pytest.approx(0.5 * np.sqrt(2), rel=1e-5)
    assert means(errors, "height")["rigid"] == pytest.approx(0.5, rel=1e-5)
    np.testing.assert_allclose(errors.growth["rigid"], [0.5 * np.sqrt(3)] * HORIZON, rtol=1e-5)


def test_headings_are_compared_around_the_circle():
    windows = straight(1)
    turned = windows.state.at[..., 3:6].set(jnp.array([0.1, -0.2, 3.1]))
    recorded = windows.replace(state=turned.at[:, CONTEXT + 1 :, 5].set(-3.1))
    errors = errors_of(Recording(), turned[0], recorded)
    assert means(errors, "heading")["rigid"] == pytest.approx(2 * np.pi - 6.2, rel=1e-4)
    assert means(errors, "tilt")["rigid"] == pytest.approx(0.0, abs=1e-6)


def test_tilt_is_the_angle_between_verticals_as_the_body_sees_them():
    rng = np.random.default_rng(0)
    ours, theirs = rng.uniform(-1.2, 1.2, (2, 5, 2))
    windows = straight(5)
    truth = windows.state.at[:, CONTEXT + 1 :, 3:5].set(ours[:, None])
    predicted = windows.state.at[:, CONTEXT + 1 :, 3:5].set(theirs[:, None])
    predicted = predicted.at[..., 5].set(rng.uniform(-3, 3, (5, 1)))
    test = TestWindows(windows.replace(state=truth), np.arange(5), GROUND)
    states = VehicleState.from_vector(predicted[:, CONTEXT + 1 :])
    errors, _ = prediction.absolute_errors(states, test)
    up = [
        Rotation.from_euler("xyz", np.c_[both, np.zeros(5)]).inv().apply([0, 0, 1])
        for both in (ours, theirs)
    ]
    expected = np.arccos(np.sum(up[0] * up[1], axis=1))
    np.testing.assert_allclose(errors["tilt"][:, -1], expected, rtol=1e-4)


def test_speed_is_forward_and_has_a_sign():
    windows = straight(1)
    backwards = windows.state[0].at[:, 6].multiply(-1.0)
    assert means(errors_of(Recording(), backwards, windows), "speed")["rigid"] == 2.0


def test_constant_velocity_is_right_on_straight_drives():
    errors = errors_of(ConstantVelocity(), None, straight())
    assert means(errors)["rigid"] < 1e-5
    assert errors.count == {"rigid": 5}


def test_a_lost_model_counts_as_one_that_did_not_move():
    errors = errors_of(Faulty(), jnp.float32(3.5), straight())
    assert errors.diverged == 2
    driven = 0.1 * HORIZON * np.array([0, 0, 0, 4, 5])
    found = errors.final["position"]["rigid"]
    assert found.mean == pytest.approx(driven.mean(), rel=1e-4)
    assert found.low < found.mean < found.high


def test_interval_covers_the_mean_as_often_as_it_says_though_drives_differ():
    rng = np.random.default_rng(0)
    drive = np.repeat(np.arange(60), 4)
    covered, naive = [], []
    for _ in range(300):
        values = rng.exponential(size=60)[drive] * rng.uniform(0.8, 1.2, drive.size)
        for groups, hits in ((drive, covered), (np.arange(drive.size), naive)):
            found = prediction.bootstrap(values, groups)
            hits.append(found.low < 1 < found.high)
    assert 0.89 < np.mean(covered) < 0.99
    assert np.mean(naive) < 0.8


def test_kinds_of_ground_are_apart():
    windows = straight(4).replace(ground=jnp.array([0, 2, 2, 0]))
    errors = errors_of(Faulty(), jnp.float32(0.0), windows)
    assert errors.count == {"rigid": 2, "transition": 2}
    assert means(errors)["rigid"] == pytest.approx(0.6 * 2.5, rel=1e-4)
    assert means(errors)["transition"] == pytest.approx(0.6 * 2.5, rel=1e-4)


def test_tables():
    rows = [
        replace(errors_of(Faulty(), jnp.float32(0.0), straight()), name="still"),
        replace(errors_of(ConstantVelocity(), None, straight()), name="constant velocity"),
    ]
    lines = prediction.format_table(rows, "position").splitlines()
    assert lines[0].startswith("6-step position error, m")
    head, _, still, constant = (
        [cell.strip() for cell in line.split("|")[1:-1]] for line in lines[2:]
    )
    assert head == ["model", "rigid (n = 5)", "diverged"]
    assert still[0] == "still" and still[1].startswith("1.800 (") and still[2] == "5"
    assert constant == ["constant velocity", "0.000 (0.000-0.000)", "0"]


def drives_of(lengths, deformable_from=10**6):
    """Straight drives at 1, 2, ... m/s, as long as told, on soil from a step on."""
    steps, count = max(lengths), len(lengths)
    speed = 1.0 + np.arange(count, dtype=np.float32)[:, None]
    state = np.zeros((count, steps + 1, 12), np.float32)
    state[..., 0], state[..., 6] = 0.1 * speed * np.arange(steps + 1), speed
    control = np.zeros((count, steps, 2), np.float32)
    control[..., 0] = speed
    soft = np.arange(steps + 1) >= deformable_from
    kinds = np.broadcast_to(np.where(soft, MUD, GRASS)[None, :, None], (count, steps + 1, 4))
    lengths, world = np.array(lengths, np.int32), np.zeros(count, np.int32)
    return Drives(state, control, lengths, kinds.astype(np.uint8), world, WheelSignals())


def test_windows_of_a_horizon_are_those_of_this_horizon_alone():
    # 4 + 3, 4 + 6 and 4 + 12 steps fit in differently many places of the three drives.
    drives, horizons = drives_of([20, 11, 8], deformable_from=9), (6, 3, 12)
    every, tests = TestWindows.nested(drives, GROUND, CONTEXT, horizons, 2)
    assert list(tests) == [3, 6, 12]
    predicted = prediction.predict(ConstantVelocity(), None, every)
    for steps, (rows, test) in tests.items():
        alone = TestWindows.of(drives, GROUND, CONTEXT, steps, 2)
        np.testing.assert_array_equal(test.drive, alone.drive)
        chex.assert_trees_all_equal(test.windows, alone.windows)
        # What is predicted once for all horizons is what is predicted for it alone.
        chex.assert_trees_all_equal(
            predicted.cut(rows, steps), prediction.predict(ConstantVelocity(), None, alone)
        )
    assert [len(test.drive) for _, test in tests.values()] == [7 + 3 + 1, 6 + 1, 3]
    with pytest.raises(DataError, match="at least 25 steps, found at most 20"):
        TestWindows.nested(drives, GROUND, CONTEXT, (3, 21), 2)


@dataclass(frozen=True)
class Climbing:
    """Constant velocity, and a climb of as many m a step as its parameters say."""

    def init(self, params, terrain, state):
        return ()

    def step(self, params, terrain, history, state, command):
        after, _ = ConstantVelocity().step(None, terrain, (), state, command)
        return replace(after, position=after.position + jnp.array([0, 0, params])), ()


def test_the_gain_by_other_parameters_is_what_they_err_less():
    drives = drives_of([40, 50, 60])
    worse, better = (jnp.float32(x) for x in (0.02, 0.01))
    found = prediction.gain(Climbing(), worse, better, drives, GROUND)
    assert (found.mean, found.low, found.high) == pytest.approx([0.16] * 3, rel=1e-3)
    assert prediction.gain(Climbing(), better, worse, drives, GROUND).high < 0


def test_error_is_found_where_it_is():
    semantic = np.full((16, 16), 3)
    semantic[:, 8:] = terrain_map.STANDARD.names.index("mud")  # east of x = 0
    terrain = TerrainMap.from_array(np.zeros((65, 65)), semantic)
    windows = straight(4)
    x = jnp.array([-20.0, -3.0, 0.5, 20.0])
    windows = windows.replace(state=windows.state.at[..., 0].add(x[:, None]))
    chassis = jnp.zeros((4, CONTEXT + HORIZON + 1, 3)).at[3, -1, 2].set(100.0)
    windows = windows.replace(wheels=windows.wheels.replace(chassis_force=chassis))
    start = np.asarray(windows.state[:, CONTEXT, 0])
    shares = error_sources.shares(
        TestWindows(windows, np.arange(4), terrain), np.array([1.0, 2.0, 3.0, 4.0])
    )
    found = {(row["quantity"], row["value"]): row for row in shares}
    mud = found["ground under the vehicle", "mud"]
    assert mud["windows, %"] == 100 * np.mean(start > 0)
    assert mud["error, %"] == pytest.approx(70)
    assert found["belly", "on the ground"]["mean error, m"] == 4.0
    assert found["border of soil, m away", "8 and more"]["windows, %"] == 50
    assert found["speed at the start, m/s", "0.5 to 1.5"]["mean error, m"] == 1.0
    borders = [row["value"] for row in shares if row["quantity"].startswith("border")]
    assert borders == ["1 to 2", "2 to 4", "8 and more"]
    for quantity in {row["quantity"] for row in shares}:
        parts = [row for row in shares if row["quantity"] == quantity]
        assert sum(row["windows, %"] for row in parts) == pytest.approx(100)
        assert sum(row["error, %"] for row in parts) == pytest.approx(100)


@pytest.mark.integration
def test_the_built_in_simulator_beats_both_baselines_on_chrono_drives():
    drives, terrain = dataset.load_drives(DRIVES, "train")
    test = TestWindows.of(drives, terrain, context=16, horizon=16, stride=16)
    vehicle = load_vehicle()
    models = (
        (Simulator(), chrono_like(vehicle)),
        (KinematicBicycle(), bicycle_of(vehicle)),
        (ConstantVelocity(), None),
    )
    errors = []
    for model, params in models:
        final = prediction.predict(model, params, test).states.position[:, -1]
        truth = test.windows.state[:, -1, :3]
        errors.append(float(jnp.linalg.norm(final - truth, axis=-1).mean()))
    simulator, bicycle, constant = errors
    assert jnp.isfinite(jnp.asarray(errors)).all()
    assert simulator < 0.35
    assert simulator < 0.7 * bicycle
    assert simulator < 0.7 * constant


def test_predictions_are_of_the_selected_worlds():
    rise = np.tile(0.2 * (np.arange(65) - 32.0), (65, 1)) + 8
    terrain = terrain_map.stack([GROUND, TerrainMap.from_array(rise, np.full((8, 8), 3))])
    windows = straight(2).replace(world=jnp.array([0, 1]))
    test = TestWindows(windows, np.arange(2), terrain)
    final = prediction.predict(KinematicBicycle(), bicycle_of(load_vehicle()), test).states
    assert float(final.rpy[0, -1, 1]) == pytest.approx(0.0, abs=1e-6)
    assert float(final.rpy[1, -1, 1]) == pytest.approx(-np.arctan(0.2), abs=1e-4)


def untrained():
    """NeSAM, which has learned nothing beside physics."""
    config = ModelConfig(parts=("nesam",), terrain="none", vehicles="any")
    params = config.init_params(jax.random.key(0), chrono_like(load_vehicle()))
    model = Alone(config.nesam)
    return model, Partial(moving, with_soil(model.part_of(params), None))


@pytest.mark.integration
@pytest.mark.parametrize("model", [lambda: (Simulator(), Partial(chrono_like)), untrained])
def test_every_world_is_predicted_with_its_own_vehicle(model):
    """Two vehicles accelerate and turn on worlds of their own; each is its own best model."""
    configs = load("hmmwv"), replace(load("hmmwv"), mass=5e3, drive="rear", wheel_torque=2e3)
    terrain, steps = terrain_map.stack([GROUND, GROUND]), CONTEXT + HORIZON
    control = jnp.broadcast_to(jnp.array([4.0, 0.2]), (steps, 2))
    commands, states = Command.from_vector(control), []
    for config in configs:
        params = chrono_like(config.vehicle)
        start = place(GROUND, vehicle=params.vehicle, speed=1.0)
        driven = rollout(Simulator(), params, GROUND, start, commands)
        states.append(jnp.concatenate([start.vector[None], driven.vector]))
    world = jnp.arange(2)
    recorded = Windows(jnp.stack(states), jnp.stack([control] * 2), world, 0 * world, CONTEXT)
    test = TestWindows(recorded, np.arange(2), terrain)

    def errors(*order):
        vehicles = stack([configs[i].vehicle for i in order])
        found = prediction.predict(*model(), test, vehicles).states
        return prediction.absolute_errors(found, test)[0]["position"][:, -1]

    assert errors(0, 1).max() < 2e-3
    assert errors(1, 0).min() > 0.1
