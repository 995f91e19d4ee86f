from dataclasses import dataclass, replace
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax import runs
from vertiwm_jax.evaluation import prediction
from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.learning import dataset, fitting, objectives, windows
from vertiwm_jax.learning.fitting import FitConfig
from vertiwm_jax.learning.losses import LossConfig, step_loss, trajectory_loss
from vertiwm_jax.learning.objectives import RolloutLoss, TeacherForcingLoss
from vertiwm_jax.learning.problem import WindowConfig, WindowData, WindowProblem
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.kinematic import ConstantVelocity, KinematicBicycle, bicycle_of
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.runs import Run
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import MapError
from vertiwm_jax.training import TrainingError

DRIVES = Path(__file__).parents[1] / "data" / "chrono_drives"
CONFIG = WindowConfig(batch=16, context=2, horizon=8, validation=10)
BICYCLE = KinematicBicycle()


@pytest.fixture(scope="module")
def recorded():
    return dataset.load_drives(DRIVES, "train")


@pytest.fixture(scope="module")
def data(recorded):
    return WindowData.of(CONFIG, recorded, recorded)


@dataclass(frozen=True)
class Drift:
    """Moves by its parameters a step and remembers how many steps it has taken."""

    def init(self, params, terrain, state):
        return jnp.int32(0)

    def step(self, params, terrain, history, state, command):
        return replace(state, position=state.position + params), history + 1


def window(seed=0, context=2, horizon=4):
    rng = np.random.default_rng(seed)
    steps = context + horizon
    return windows.Windows(
        state=jnp.asarray(rng.normal(size=(steps + 1, 12)), jnp.float32),
        control=jnp.asarray(rng.normal(size=(steps, 2)), jnp.float32),
        world=jnp.int32(0),
        ground=jnp.int32(0),
        context=context,
    )


def test_open_loop_starts_where_the_context_ends():
    one, step = window(), jnp.array([0.1, -0.2, 0.3])
    predicted, ages = objectives.open_loop(Drift(), step, None, one, lambda history: history)
    expected = one.state[2, :3] + step * np.arange(1, 5)[:, None]
    np.testing.assert_allclose(predicted.position, expected, rtol=1e-5)
    np.testing.assert_array_equal(ages, [3, 4, 5, 6])


def test_open_loop_is_a_step_after_the_other(data):
    one = jax.tree.map(lambda x: x[7], data.validation)
    terrain, params = data.validation_terrain.select(one.world), bicycle_of(load_vehicle())
    state = VehicleState.from_vector(one.state[CONFIG.context])
    found, _ = objectives.open_loop(BICYCLE, params, terrain, one, lambda _: None)
    step = jax.jit(BICYCLE.step)
    for k, control in enumerate(one.control[CONFIG.context :]):
        state, _ = step(params, terrain, (), state, Command.from_vector(control))
        np.testing.assert_allclose(found.vector[k], state.vector, atol=1e-4)


def test_the_rollout_loss_is_the_trajectory_loss_with_its_coefficients():
    one, step, config = window(), jnp.array([0.1, -0.2, 0.3]), LossConfig(coefficient_change=0.5)
    predicted, _ = objectives.open_loop(Drift(), step, None, one, lambda _: None)
    truth = VehicleState.from_vector(one.state[3:])
    plain = RolloutLoss(Drift(), config)(step, None, one)
    np.testing.assert_allclose(plain, trajectory_loss(config, predicted, truth), rtol=1e-6)
    fused = RolloutLoss(Drift(), config, lambda age: 0.1 * age * jnp.ones(4))(step, None, one)
    np.testing.assert_allclose(fused, plain + 0.5 * 4 * 0.01, rtol=1e-5)


def test_teacher_forcing_starts_every_step_from_the_record():
    one, step, deviation = window(), jnp.array([0.1, -0.2, 0.3]), tuple(0.1 * np.arange(1, 13))
    losses = []
    for before, after in zip(one.state[:-1], one.state[1:], strict=True):
        moved = before.at[:3].add(step)
        states = (VehicleState.from_vector(x) for x in (before, moved, after))
        losses.append(step_loss(jnp.array(deviation), *states))
    found = TeacherForcingLoss(Drift(), deviation)(step, None, one)
    np.testing.assert_allclose(found, np.mean(losses), rtol=1e-5)


def test_windows_are_drawn_by_their_weights(recorded):
    weights = (1.0, 0.0, 5.0)
    data = WindowData.of(replace(CONFIG, weights=weights), recorded, recorded)
    ground = np.asarray(data.index.ground)
    chance = np.diff(np.asarray(data.share), prepend=0)
    expected = np.array(weights)[ground] / np.array(weights)[ground].sum()
    np.testing.assert_allclose(chance, expected, atol=1e-6)

    @dataclass(frozen=True)
    class Counted:
        """The share of transition windows in place of a loss."""

        def __call__(self, params, terrain, window):
            return (window.ground == 2).astype(jnp.float32)

    problem = WindowProblem(BICYCLE, Counted(), replace(CONFIG, batch=4000))
    share = float(problem.loss(None, data, jax.random.key(0)))
    assert share == pytest.approx(chance[ground == 2].sum(), abs=0.03)


def test_batches_are_of_mirrored_windows_as_often_as_not(data, recorded):
    @dataclass(frozen=True)
    class Image:
        """Whether a window is a mirror image, in place of a loss."""

        def __call__(self, params, terrain, window):
            return (terrain.world >= 3).astype(jnp.float32)

    problem = WindowProblem(BICYCLE, Image(), replace(CONFIG, batch=2000))
    assert 0.4 < float(problem.loss(None, data, jax.random.key(0))) < 0.6
    as_is = replace(CONFIG, mirror=False)
    problem = WindowProblem(BICYCLE, Image(), as_is)
    plain = WindowData.of(as_is, recorded, recorded)
    assert plain.terrain.worlds == 3
    assert float(problem.loss(None, plain, jax.random.key(0))) == 0


def test_each_window_is_of_the_vehicle_that_drove_there(recorded):
    drives, terrain = recorded
    hmmwv = vehicle.load("hmmwv")
    heavy = tuple(replace(hmmwv, mass=1000.0 * (1 + world)) for world in range(terrain.worlds))
    drives = replace(drives, described=(*heavy[:-1], None))

    class Mass:
        """Whether the vehicle is that of the world, in place of a loss."""

        def __call__(self, params, terrain, window):
            masses = jnp.array([*(each.mass for each in heavy[:-1]), hmmwv.mass])
            return (params.vehicle.mass == masses[window.world % 3]).astype(jnp.float32)

    data = WindowData.of(CONFIG, (drives, terrain), (drives, terrain), otherwise=hmmwv.vehicle)
    problem = WindowProblem(BICYCLE, Mass(), replace(CONFIG, batch=500))
    assert float(problem.loss(chrono_like(load_vehicle()), data, jax.random.key(0))) == 1


def test_validation_is_the_error_of_the_tables(data):
    params = bicycle_of(load_vehicle())
    problem = WindowProblem(BICYCLE, RolloutLoss(BICYCLE), CONFIG)
    found = jax.jit(problem.validate)(params, data)
    drive = np.arange(len(data.validation.world))
    test = TestWindows(data.validation, drive, data.validation_terrain)
    states = prediction.predict(BICYCLE, params, test).states
    table = prediction.summary("bicycle", states, test)
    assert table.count == {"rigid": 10, "deformable": 10, "transition": 10}
    means = {kind: interval.mean for kind, interval in table.final["position"].items()}
    for kind, mean in means.items():
        assert float(found[f"error_{kind}"]) == pytest.approx(mean, rel=1e-4)
    assert float(found["error"]) == pytest.approx(np.mean(list(means.values())), rel=1e-4)
    assert found["diverged"] == 0


def test_a_prediction_that_is_lost_counts_as_one_that_did_not_move(data):
    @dataclass(frozen=True)
    class Lost:
        def init(self, params, terrain, state):
            return ()

        def step(self, params, terrain, history, state, command):
            return replace(state, position=state.position * jnp.nan), ()

    found = WindowProblem(Lost(), RolloutLoss(Lost()), CONFIG).validate(None, data)
    state = np.asarray(data.validation.state)
    driven = np.linalg.norm(state[:, -1, :3] - state[:, 2, :3], axis=-1)
    rigid = np.asarray(data.validation.ground) == 0
    assert float(found["error_rigid"]) == pytest.approx(driven[rigid].mean(), rel=1e-4)
    assert found["diverged"] == 1


def test_a_kind_of_ground_that_nobody_drove_on_has_no_error(recorded):
    drives, terrain = recorded
    rigid = jax.tree.map(lambda x: x[np.asarray(drives.world) == 2], drives)
    data = WindowData.of(CONFIG, (rigid, terrain), (rigid, terrain))
    found = WindowProblem(ConstantVelocity(), RolloutLoss(ConstantVelocity()), CONFIG).validate(
        None, data
    )
    assert np.isnan(found["error_deformable"]) and np.isnan(found["error_transition"])
    assert found["error"] == found["error_rigid"]
    with pytest.raises(ValueError, match="weights: expected one above 0"):
        WindowData.of(replace(CONFIG, weights=(0.0, 1.0, 1.0)), (rigid, terrain), (rigid, terrain))


@pytest.mark.integration
def test_a_bicycle_learns_from_chrono(data, tmp_path):
    config = FitConfig(
        updates=150,
        updates_per_iteration=50,
        learning_rate=0.05,
        warm_up=10,
        weight_decay=0.0,
        trainable=("ride_height", "speed_lag"),
    )
    params = replace(bicycle_of(load_vehicle()), ride_height=jnp.float32(0.8))
    problem = WindowProblem(BICYCLE, RolloutLoss(BICYCLE), CONFIG)
    run = Run.create(tmp_path, "fit", config)
    fitted = fitting.fit(problem, config, params, data, jax.random.key(0), run)
    lines = runs.read_metrics(run.folder)
    assert lines[-1]["loss"] < 0.8 * float(problem.loss(params, data, jax.random.key(1)))
    assert lines[-1]["best_error"] < 0.9 * float(problem.validate(params, data)["error"])
    assert 0.38 < float(fitted.ride_height) < 0.46
    chex.assert_trees_all_equal((fitted.wheelbase, fitted.track), (params.wheelbase, params.track))
    with pytest.raises(TrainingError, match=r"iteration 1: .* finite; nothing was saved"):
        spoilt = replace(data, drives=replace(data.drives, state=data.drives.state * jnp.nan))
        run = Run.create(tmp_path, "fit", config)
        fitting.fit(problem, config, params, spoilt, jax.random.key(0), run)


def test_maps_that_are_not_square_cannot_be_mirrored(recorded):
    drives, terrain = recorded
    wide = replace(terrain, elevation=terrain.elevation[:, :-1])
    with pytest.raises(MapError, match="expected a square map, found 128 x 129; turn mirroring"):
        WindowData.of(CONFIG, (drives, wide), recorded)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"batch": 0}, "batch: expected at least 1, found 0"),
        ({"context": -1}, "context: expected at least 0, found -1"),
        ({"weights": (1.0, -1.0, 1.0)}, "weights: expected at least 0"),
    ],
)
def test_settings_out_of_range_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **change)
