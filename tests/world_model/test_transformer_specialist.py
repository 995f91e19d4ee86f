from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
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

from vertiwm_jax.dynamics import rollout, warm_up
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.world_model.sizes import BASE, PAPER
from vertiwm_jax.world_model.specialist_network import WINDOW
from vertiwm_jax.world_model.transformer_specialist import TransformerSpecialist

KEY, TERRAIN = jax.random.key(0), rough()
MODELS = {kind: TransformerSpecialist(TINY, kind) for kind in ("patches", "indicator", "none")}
MODEL = MODELS["patches"]
UNTRAINED = {kind: jax.jit(model.init_params)(KEY, CONSTANTS) for kind, model in MODELS.items()}
PARAMS = {kind: moved(params) for kind, params in UNTRAINED.items()}


def predict(params, terrain, state, commands, model=MODEL):
    history = model.init(params, terrain, state)
    return rollout(model, params, terrain, state, commands, history)


predicted = jax.jit(predict, static_argnames="model")


def test_sizes():
    base, paper = (
        count(jax.eval_shape(TransformerSpecialist(size).init_params, KEY).network)
        for size in (BASE, PAPER)
    )
    assert 500_000 < base < 700_000
    assert paper == pytest.approx((9_972_634 - 33_764) / 2, rel=0.03)


def test_starts_from_the_mean_transition():
    state = driving()
    states = predicted(UNTRAINED["patches"], TERRAIN, state, commands(8))
    np.testing.assert_allclose(states.velocity[0], state.velocity, atol=1e-6)
    distance = np.linalg.norm(states.position[0] - state.position)
    assert distance == pytest.approx(0.1 * np.linalg.norm(state.velocity), rel=1e-3)


@pytest.mark.parametrize("kind", MODELS)
def test_cached_steps_along_a_drive_equal_the_whole_sequence(kind):
    model, params, steps = MODELS[kind], PARAMS[kind], WINDOW + 9
    drive = driving(1, steps)

    @jax.jit
    def cached(params, states, commands):
        def advance(carry, inputs):
            state, command = inputs
            # Recorded states do not follow from each other as predicted ones do.
            history = replace(carry, perception=model.init(params, TERRAIN, state).perception)
            proposed, history = model.step(params, TERRAIN, history, state, command)
            return history, proposed

        start = model.init(params, TERRAIN, one(states, 0))
        return jax.lax.scan(advance, start, (states, commands))[1]

    one_by_one = cached(params, drive, commands(steps))
    at_once = jax.jit(model.follow)(params, TERRAIN, drive, commands(steps))
    changes = np.abs(one_by_one.velocity - drive.velocity).max(-1)
    assert (changes > 1e-2).mean() > 0.8  # it does something
    np.testing.assert_allclose(one_by_one.vector, at_once.vector, atol=2e-5)


def test_history_sees_the_state_that_was_returned():
    state, params = driving(), PARAMS["patches"]
    init, step = jax.jit(MODEL.init), jax.jit(MODEL.step)
    history = init(params, TERRAIN, state)
    command = Command(jnp.float32(3), jnp.float32(0.2))
    after, following = step(params, TERRAIN, history, state, command)
    expected = init(params, TERRAIN, after).perception
    np.testing.assert_allclose(following.perception.latent, expected.latent, atol=1e-3)
    assert float(jnp.abs(expected.latent - history.perception.latent).max()) > 0.1


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
    def loss(params):
        return jnp.sum(MODEL.follow(params, TERRAIN, driving(0, 2), commands(2)).velocity ** 2)

    gradient = jax.jit(jax.grad(loss))(PARAMS["patches"])
    assert not any(bool(np.any(x)) for x in jax.tree.leaves(gradient.encoders))
    assert all(bool(np.any(x)) for x in jax.tree.leaves(gradient.network))
    assert not any(bool(np.any(x)) for x in jax.tree.leaves(gradient.normalisation))


def test_gradients_through_a_warmed_up_rollout_are_finite():
    drive, before, after = driving(6, 9), commands(8), commands(16, seed=2)

    def loss(params, drive):
        history = warm_up(MODEL, params, TERRAIN, drive, before)
        state = jax.tree.map(lambda x: x[-1], drive)
        return jnp.sum(rollout(MODEL, params, TERRAIN, state, after, history).position[-1])

    gradient, by_drive = jax.jit(jax.grad(loss, argnums=(0, 1)))(PARAMS["patches"], drive)
    leaves = jax.tree.leaves((gradient, by_drive))
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert all(np.any(leaf) for leaf in jax.tree.leaves(gradient.network))
    assert np.any(by_drive.velocity[0])  # the context reaches the end through the cache
