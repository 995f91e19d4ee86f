from dataclasses import replace
from functools import partial

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

from vertiwm_jax.dynamics import along, rollout, warm_up
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.networks.specialist import BASE, PAPER, PAPER_WHOLE, WINDOW
from vertiwm_jax.perception.features import init_pair, init_reduce
from vertiwm_jax.perception.perceive import perceive
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.world_model import motion
from vertiwm_jax.world_model.alone import Alone
from vertiwm_jax.world_model.transformer import Transformer
from vertiwm_jax.world_model.verti_wm import VertiWMParams

KEY, TERRAIN = jax.random.key(0), rough()
MODELS = {kind: Alone(Transformer(TINY, kind)) for kind in ("patches", "indicator", "none")}
MODEL = MODELS["patches"]


def init_params(model, key=KEY):
    """Untrained parameters of one specialist."""
    encoders = replace(init_pair(key), reduce=init_reduce(key, TINY.channels))
    own = model.specialist.init_params(key, CONSTANTS)
    return VertiWMParams((encoders,), load_vehicle(), transformer=own)


def changed(params):
    """Every weight that learns has moved from its first value."""
    own, (encoders,), rng = moved(params.transformer), params.encoders, np.random.default_rng(1)
    reduce = jax.tree.map(
        lambda x: jnp.asarray(x + rng.normal(0, 0.1, x.shape), jnp.float32), encoders.reduce
    )
    return replace(params, transformer=own, encoders=(replace(encoders, reduce=reduce),))


UNTRAINED = {kind: init_params(model) for kind, model in MODELS.items()}
PARAMS = {kind: changed(params) for kind, params in UNTRAINED.items()}


def predict(params, terrain, state, commands, model=MODEL):
    history = model.init(params, terrain, state)
    return rollout(model, params, terrain, state, commands, history)


predicted = jax.jit(predict, static_argnames="model")


def test_sizes():
    base, paper, whole = (
        count(jax.eval_shape(Transformer(size).init_params, KEY).network)
        + count(init_reduce(KEY, size.channels))
        for size in (BASE, PAPER, PAPER_WHOLE)
    )
    assert 500_000 < base < 700_000
    assert paper == pytest.approx((9_972_634 - 33_764) / 2, rel=0.03)
    assert whole == pytest.approx(9_871_128, rel=0.03)


def test_starts_from_the_mean_transition():
    state = driving()
    states = predicted(UNTRAINED["patches"], TERRAIN, state, commands(8))
    np.testing.assert_allclose(states.velocity[0], state.velocity, atol=1e-6)
    distance = np.linalg.norm(states.position[0] - state.position)
    assert distance == pytest.approx(0.1 * np.linalg.norm(state.velocity), rel=1e-3)


@pytest.mark.parametrize("kind", MODELS)
def test_steps_along_a_drive_equal_the_whole_sequence(kind):
    """Recorded states do not follow from each other as predicted ones do."""
    model, params, steps = MODELS[kind], PARAMS[kind], WINDOW + 9
    drive, control = driving(1, steps), commands(steps)
    found, *_ = jax.jit(partial(along, model))(params, TERRAIN, drive, control)

    @jax.jit
    def at_once(params, states, commands):
        own, constants = params.transformer, params.transformer.normalization
        seen = jax.vmap(lambda state: perceive(params.encoders, TERRAIN, state))(states)
        below = model.specialist._ground(TERRAIN, seen[0], states)
        inputs = constants.inputs(states, commands)
        output = sequences.specialist(own.network["params"], inputs, below, TINY, WINDOW)
        return motion.advance(states, constants.transition(output))

    expected = at_once(params, drive, control)
    changes = np.abs(found.velocity - drive.velocity).max(-1)
    assert (changes > 1e-2).mean() > 0.8  # it does something
    np.testing.assert_allclose(found.vector, expected.vector, atol=2e-5)


def test_history_sees_the_state_that_was_returned():
    state, params = driving(), PARAMS["patches"]
    init, step = jax.jit(MODEL.init), jax.jit(MODEL.step)
    history = init(params, TERRAIN, state)
    command = Command(jnp.float32(3), jnp.float32(0.2))
    after, following = step(params, TERRAIN, history, state, command)
    (expected,) = init(params, TERRAIN, after).features
    np.testing.assert_allclose(following.features[0].reduced, expected.reduced, atol=1e-3)
    assert float(jnp.abs(expected.reduced - history.features[0].reduced).max()) > 0.1


def test_a_batch_is_a_loop_and_one_trace_serves_all_drives():
    alone = partial(predict, PARAMS["patches"], TERRAIN)
    check_batches(alone, driving(2, 3), commands(8, 3), 1e-4)


def test_steps_in_a_host_loop_are_traced_once():
    traces = 0

    @jax.jit
    def step(params, terrain, history, state, command):
        nonlocal traces
        traces += 1
        return MODEL.step(params, terrain, history, state, command)

    state, control = driving(), commands(8)
    history = jax.jit(MODEL.init)(PARAMS["patches"], TERRAIN, state)
    expected = predicted(PARAMS["patches"], TERRAIN, state, control)
    for i in range(8):
        state, history = step(PARAMS["patches"], TERRAIN, history, state, one(control, i))
    assert traces == 1
    np.testing.assert_allclose(state.vector, expected.vector[-1], atol=1e-4)


def test_moving_turning_and_lifting_the_world_moves_turns_and_lifts_the_drive():
    """A quarter turn to the left about the middle of the map, to another place and height."""
    lift, place = 5.0, np.array([30.0, -60.0, 0.0])
    other = rough(
        lift=lift,
        elevation=np.rot90(np.asarray(TERRAIN.elevation[0])),
        semantic=np.rot90(np.asarray(TERRAIN.semantic[0])),
    )
    other = replace(other, origin=other.origin + place[:2])
    state = driving(4)

    def carried(state: VehicleState) -> VehicleState:
        x, y, z = jnp.moveaxis(state.position, -1, 0)
        position = jnp.stack([-y, x, z + lift], axis=-1) + place
        return replace(state, position=position, rpy=state.rpy + jnp.array([0, 0, np.pi / 2]))

    params, control = PARAMS["patches"], commands(8)
    expected = carried(predicted(params, TERRAIN, state, control))
    found = predicted(params, other, carried(state), control)
    # Some pixels on a border between classes fall to its other side.
    np.testing.assert_allclose(found.position, expected.position, atol=2e-3)
    turned = np.abs(np.exp(1j * found.rpy) - np.exp(1j * expected.rpy))
    np.testing.assert_allclose(turned, 0, atol=2e-3)
    np.testing.assert_allclose(found.velocity, expected.velocity, atol=5e-3)


def test_each_kind_of_terrain_input_is_told_what_it_should_be():
    state, control = driving(5), commands(8)
    level = rough(elevation=np.full((49, 49), 4.0))
    ground = {"rigid": 0, "soil": 9}
    assert [bool(TERRAIN.deformable[i]) for i in ground.values()] == [False, True]
    plain = {k: rough(semantic=np.full((12, 12), i)) for k, i in ground.items()}

    def differs(kind, one, other):
        a, b = (
            predicted(PARAMS[kind], t, state, control, model=MODELS[kind]) for t in (one, other)
        )
        return bool(np.abs(a.velocity - b.velocity).max() > 1e-3)

    found = {
        kind: (differs(kind, plain["rigid"], plain["soil"]), differs(kind, TERRAIN, level))
        for kind in MODELS
    }
    assert found == {"patches": (True, True), "indicator": (True, False), "none": (False, False)}


def test_the_next_query_pose_counts_as_given():
    """Place and height matter by sight alone, and sight has no gradient: it must be zero."""
    state, control = driving(), commands(3)

    @jax.jit
    def slope(position):
        def velocity(position):
            start = replace(state, position=position)
            return predict(PARAMS["patches"], TERRAIN, start, control).velocity[-1]

        return jax.jvp(velocity, (position,), (jnp.ones(3),))

    velocity, by_position = slope(state.position)
    elsewhere, _ = slope(state.position + 1)
    assert not np.any(by_position) and bool(jnp.all(jnp.abs(velocity - elsewhere) > 1e-4))


def test_encoders_and_constants_never_learn():
    model, drive = replace(MODEL, latents=True), driving(0, 2)

    def loss(params):
        predicted, *_ = along(model, params, TERRAIN, drive, commands(2))
        return jnp.sum(predicted.velocity**2)

    gradient = jax.jit(jax.grad(loss, allow_int=True))(PARAMS["patches"])
    (encoders,) = gradient.encoders
    still = encoders.elevation, encoders.semantic, gradient.transformer.normalization
    assert not any(bool(np.any(x)) for x in jax.tree.leaves(still))
    learns = gradient.transformer.network, encoders.reduce
    assert all(bool(np.any(x)) for x in jax.tree.leaves(learns))


@pytest.mark.integration
def test_the_first_layer_learns_only_from_latents():
    def away(encoders, commands, model):
        params, state = replace(PARAMS["patches"], encoders=encoders), driving()
        return jnp.sum(predict(params, TERRAIN, state, commands, model).position[-1])

    slope = jax.jit(jax.grad(away, argnums=1), static_argnums=2)
    encoders, control = PARAMS["patches"].encoders, commands(8)
    expected, found = (
        slope(encoders, control, replace(MODEL, latents=kept)) for kept in (True, False)
    )
    np.testing.assert_allclose(found.vector, expected.vector, atol=1e-4)
    assert np.any(expected.vector)
    with pytest.raises(TypeError, match=r"encoders.reduce: expected a model that keeps latents"):
        jax.grad(away)(encoders, control, MODEL)


@pytest.mark.integration
def test_gradients_through_a_warmed_up_rollout_are_finite():
    drive, before, after = driving(6, 9), commands(8), commands(16, seed=2)

    def loss(params, drive):
        history = warm_up(MODEL, params, TERRAIN, drive, before)
        state = jax.tree.map(lambda x: x[-1], drive)
        return jnp.sum(rollout(MODEL, params, TERRAIN, state, after, history).position[-1])

    by_weights = jax.grad(
        lambda own, drive: loss(replace(PARAMS["patches"], transformer=own), drive), argnums=(0, 1)
    )
    gradient, by_drive = jax.jit(by_weights)(PARAMS["patches"].transformer, drive)
    leaves = jax.tree.leaves((gradient, by_drive))
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert all(np.any(leaf) for leaf in jax.tree.leaves(gradient.network))
    assert np.any(by_drive.velocity[0])  # the context reaches the end through the cache
