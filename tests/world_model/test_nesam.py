from dataclasses import dataclass, replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import sequences
from world_model.examples import (
    CONSTANTS,
    TINY,
    check_batches,
    commands,
    count,
    driving,
    moved,
    one,
    rough,
)

from vertiwm_jax.dynamics import along, rollout
from vertiwm_jax.learning import augment, calibration
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.networks.specialist import BASE, WINDOW
from vertiwm_jax.perception.features import init_pair, init_soil
from vertiwm_jax.perception.perceive import perceive
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.world_model import motion, nesam_inputs
from vertiwm_jax.world_model.alone import Alone
from vertiwm_jax.world_model.nesam import Nesam
from vertiwm_jax.world_model.verti_wm import VertiWMParams

KEY, TERRAIN = jax.random.key(0), rough()
PHYSICS = chrono_like(load_vehicle())
MODEL = Alone(Nesam(TINY))
SCALE = 0.1 * CONSTANTS.transition_deviation


def of(nesam) -> VertiWMParams:
    """Parameters of NeSAM alone, on the soils of the map."""
    return VertiWMParams((), PHYSICS.vehicle, nesam=nesam)


UNTRAINED = of(replace(Nesam(TINY).init_params(KEY, PHYSICS, CONSTANTS), correction_scale=SCALE))
PARAMS = of(moved(UNTRAINED.nesam))
KEEPS = jnp.linspace(0.9, 0.4, 6)
"""Share of each velocity that is left after a step of `Damped`."""


@dataclass(frozen=True)
class Damped(Simulator):
    """Physics that compiles in no time, and whose response to velocities is known."""

    def step(self, params, terrain, history, state, command):
        before = motion.twist(state)
        after = KEEPS * before + 0.1 * command.speed * jnp.eye(6)[0]
        increment = 0.1 * (0.7 * before + 0.3 * after)
        memory = replace(
            history,
            wheel_speed=0.5 * history.wheel_speed + command.speed,
            sinkage=0.5 * history.sinkage + 0.1,
            steering=command.steering,
        )
        return motion.moved(state, increment, after), memory


SIMPLE = Alone(Nesam(TINY, simulator=Damped()))


SHARP = Alone(replace(SIMPLE.specialist, gradient="exact"))


def standing(seed: int = 0, *batch: int) -> VehicleState:
    """As `driving`, with the wheels about on the ground."""
    state = driving(seed, *batch)
    ground = query.height(TERRAIN, state.position[..., :2])
    return replace(state, position=state.position.at[..., 2].set(ground + 0.5))


def predict(model, params, state, control, terrain=TERRAIN):
    history = model.init(params, terrain, state)
    return rollout(model, params, terrain, state, control, history)


@cache
def compiled(model):
    """Most tests share one program a model: compiling the simulator takes seconds."""
    return (
        jax.jit(partial(predict, model))
        .lower(PARAMS if isinstance(model, Alone) else PHYSICS, standing(), commands(16), TERRAIN)
        .compile()
    )


def predicted(model, params, state, control, terrain=TERRAIN):
    """The 16 states after `state`."""
    return compiled(model)(params, state, control, terrain)


def test_base_size():
    parameters = jax.eval_shape(Nesam(BASE).init_params, KEY, PHYSICS)
    assert 400_000 < count(parameters.network) < 700_000


def test_it_sees_nothing_where_soils_are_those_of_the_map():
    assert jax.jit(MODEL.init)(PARAMS, TERRAIN, standing()).features == ()


@pytest.mark.integration
def test_untrained_is_the_simulator():
    state, control = standing(), commands(16)
    expected = predicted(Simulator(), PHYSICS, state, control)
    found = predicted(MODEL, UNTRAINED, state, control)
    assert float(jnp.abs(expected.position[-1] - state.position).max()) > 1
    np.testing.assert_allclose(found.vector, expected.vector, atol=3e-4)


def test_step_adds_what_the_network_says_in_its_scale():
    state, control = standing(), commands(16)
    # With a bias alone, the output of the network is that bias.
    weights = jax.tree.map(lambda x: x, UNTRAINED.nesam.network)
    weights["params"]["head"]["bias"] = bias = jnp.linspace(-1, 1, 12)
    found = predicted(MODEL, of(replace(UNTRAINED.nesam, network=weights)), state, control)
    physics = predicted(Simulator(), PHYSICS, state, control)
    # In a mirror, it would push the same way: what is odd cancels.
    even = jnp.array([1, 0, 1, 0, 1, 0] * 2)
    expected = motion.corrected(one(physics, 0), SCALE * even * bias)
    np.testing.assert_allclose(one(found, 0).vector, expected.vector, atol=1e-5)


@pytest.mark.integration
def test_steps_along_a_drive_equal_the_whole_sequence():
    steps = WINDOW + 5
    drive, control = standing(1, steps), commands(steps)

    @jax.jit
    def at_once(params, states, commands):
        own, simulator = params.nesam, Damped()
        physics, memories, _ = along(
            simulator, PHYSICS, TERRAIN, states, commands, lambda history: history
        )
        expected = jax.tree.map(lambda x, y: jnp.concatenate([x[:1], y[:-1]]), states, physics)
        constants = own.normalization, own.correction_scale, params.vehicle
        step = expected, states, commands, physics, memories
        inputs = nesam_inputs.StepFeatures.of(*constants, *step).both
        outputs = sequences.specialist(own.network["params"], inputs, None, TINY, WINDOW)
        mean = 0.5 * (outputs[0] + nesam_inputs.MOTION_SIGNS * outputs[1])
        return physics, motion.corrected(physics, own.correction_scale * mean)

    physics, expected = at_once(PARAMS, drive, control)
    found, *_ = jax.jit(partial(along, SIMPLE))(PARAMS, TERRAIN, drive, control)
    assert float(jnp.abs(physics.velocity - found.velocity).max(-1).min()) > 1e-3
    np.testing.assert_allclose(found.vector, expected.vector, atol=1e-4)


def test_place_and_heading_do_not_matter():
    """The same hills elsewhere, and a vehicle on them that starts there."""
    state, control = standing(), commands(16)
    shift = jnp.array([10.0, -20.0, 3.0])
    elsewhere = replace(rough(lift=3.0), origin=TERRAIN.origin + shift[:2])
    there = replace(state, position=state.position + shift)
    found = predicted(MODEL, PARAMS, there, control, elsewhere)
    expected = predicted(MODEL, PARAMS, state, control)
    np.testing.assert_allclose(found.position - shift, expected.position, atol=5e-3)
    np.testing.assert_allclose(found.rpy, expected.rpy, atol=5e-3)


def test_a_mirrored_vehicle_on_mirrored_ground_drives_mirrored():
    """Although nothing about the weights is symmetric."""
    state, control = standing(4), commands(16)
    both = augment.with_mirrored(TERRAIN)
    image = replace(
        TERRAIN,
        **{name: getattr(both, name)[1:] for name in ("elevation", "semantic", "friction")},
    )

    def mirrored(state, control):
        drive = Windows(state.vector, control.vector, jnp.int32(0), jnp.int32(0), 0)
        seen = augment.mirror(drive, both)
        return VehicleState.from_vector(seen.state), Command.from_vector(seen.control)

    there, commanded = mirrored(state, control)
    found = predicted(MODEL, PARAMS, there, commanded, image)
    drive = predicted(MODEL, PARAMS, state, control)
    np.testing.assert_allclose(found.vector, mirrored(drive, control)[0].vector, atol=2e-3)
    alone = predicted(MODEL, UNTRAINED, state, control)
    assert float(jnp.abs(drive.position - alone.position)[-1].max()) > 0.02


@pytest.mark.integration
def test_gradients_reach_all_weights_through_sixteen_steps():
    own = replace(PARAMS.nesam, response=-0.4 * jnp.eye(12, 6, -6))
    state, control = standing(3), commands(16)

    def loss(network):
        final = one(predict(MODEL, of(replace(own, network=network)), state, control), -1)
        return jnp.sum(final.vector)

    gradients = jax.jit(jax.grad(loss))(own.network)
    for path, leaf in jax.tree.leaves_with_path(gradients):
        assert bool(jnp.isfinite(leaf).all()), path
        assert float(jnp.abs(leaf).max()) > 0, path


@pytest.mark.integration
def test_calibration_measures_what_physics_misses_and_how_it_answers():
    drives, steps = 6, 16
    starts, control = standing(5, drives), commands(steps, drives)
    after = jax.vmap(lambda state, u: predict(Damped(), PHYSICS, state, u))(starts, control)
    states = jax.tree.map(lambda a, b: jnp.concatenate([a[:, None], b], 1), starts, after)

    @jax.jit
    def measured(states, control):
        worlds = jnp.zeros(drives, jnp.int32)
        recorded = Windows(states.vector, control.vector, worlds, worlds, context=0)
        constants = calibration.nesam_constants
        return constants(SIMPLE.specialist, UNTRAINED, TERRAIN, recorded).nesam

    params = measured(states, control)
    np.testing.assert_allclose(params.correction_scale, 0, atol=1e-4)
    # The increment is 0.02 s times the loss of velocity more than that of the mean velocity.
    change = np.diag(KEEPS - 1)
    np.testing.assert_allclose(params.response, np.concatenate([-0.02 * change, change]), atol=1e-3)

    error = 0.3 * (-1.0) ** jnp.arange(steps + 1)
    off = replace(states, velocity=states.velocity.at[..., 0].add(error))
    # An error, and 0.9 of the opposite one before it.
    found = measured(off, control).correction_scale
    np.testing.assert_allclose(found[6], 0.3 + 0.9 * 0.3, rtol=0.01)
    np.testing.assert_allclose(found[9:], 0, atol=1e-4)


@pytest.mark.integration
def test_the_mean_gradient_is_exact_where_physics_answers_alike_everywhere():
    change = jnp.diag(KEEPS - 1)
    own = replace(PARAMS.nesam, response=jnp.concatenate([-0.02 * change, change]))
    state, control = standing(3), commands(16)

    def loss(network, model):
        final = one(predict(model, of(replace(own, network=network)), state, control), -1)
        return jnp.sum(final.vector)

    value = jax.jit(jax.value_and_grad(loss), static_argnums=1)
    mean, by_mean = value(own.network, SIMPLE)
    exact, by_exact = value(own.network, SHARP)
    np.testing.assert_allclose(mean, exact, rtol=1e-4)
    for a, b in zip(*map(jax.tree.leaves, (by_mean, by_exact)), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-2 * float(jnp.abs(b).max()))


@pytest.mark.integration
def test_a_batch_is_a_loop_and_one_trace_serves_all_drives():
    check_batches(partial(predict, SIMPLE, PARAMS), standing(2, 3), commands(16, 3), 1e-3)


def test_jit_changes_nothing():
    state, command = standing(), one(commands(1), 0)
    plain = SIMPLE.init(PARAMS, TERRAIN, state)
    found, history = jax.jit(SIMPLE.step)(PARAMS, TERRAIN, plain, state, command)
    expected, following = SIMPLE.step(PARAMS, TERRAIN, plain, state, command)
    np.testing.assert_allclose(found.vector, expected.vector, atol=1e-5)
    for a, b in zip(*map(jax.tree.leaves, (history, following)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


@pytest.mark.integration
def test_predicted_soils_are_those_of_the_predictor_wherever_it_drives():
    """Against a map whose every soil is what the predictor says of the latents."""
    state, command = standing(), one(commands(1), 0)
    pair = replace(init_pair(KEY), soil=init_soil(KEY))
    seeing = replace(UNTRAINED, encoders=(pair,))
    soil = perceive((pair,), TERRAIN, state)[0].soil
    unit_weight = query.soils(TERRAIN).unit_weight
    told = TERRAIN.with_soils(replace(soil, unit_weight=unit_weight))
    told = replace(told, deformable=jnp.ones_like(TERRAIN.deformable))
    soft = replace(TERRAIN, deformable=told.deformable)
    found, expected, other = (
        MODEL.step(params, terrain, MODEL.init(params, terrain, state), state, command)[0].vector
        for params, terrain in ((seeing, soft), (UNTRAINED, told), (UNTRAINED, soft))
    )
    np.testing.assert_array_equal(found, expected)
    assert float(jnp.abs(found - other).max()) > 1e-5


@pytest.mark.integration
def test_exact_gradients_let_commands_move_what_the_mean_gradient_holds():
    history = SIMPLE.init(UNTRAINED, TERRAIN, driving())
    command = Command(jnp.float32(2), jnp.float32(0.1))

    def speed(model, command):
        return model.step(UNTRAINED, TERRAIN, history, driving(), command)[0].velocity[0]

    np.testing.assert_array_equal(speed(SIMPLE, command), speed(SHARP, command))
    assert jax.grad(speed, argnums=1)(SIMPLE, command).speed == 0
    np.testing.assert_allclose(jax.grad(speed, argnums=1)(SHARP, command).speed, 0.1, rtol=1e-5)
