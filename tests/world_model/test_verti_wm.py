from dataclasses import dataclass, replace
from functools import partial

import chex
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
    rough,
)

from vertiwm_jax.dynamics import disagreement, rollout
from vertiwm_jax.mechanics.kinematic import KinematicBicycle, bicycle_of
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.models.config import ModelConfig
from vertiwm_jax.perception.features import init_pair, init_reduce
from vertiwm_jax.perception.perceive import perceive
from vertiwm_jax.world_model import motion, verti_wm
from vertiwm_jax.world_model.alone import Alone
from vertiwm_jax.world_model.fusion import GateParams
from vertiwm_jax.world_model.transformer import Transformer
from vertiwm_jax.world_model.verti_wm import VertiWM, VertiWMParams

TERRAIN = rough()


@dataclass(frozen=True)
class Bicycle:
    """Physics without forces in the place of NeSAM."""

    def init(self, params, vehicle, terrain, state):
        return KinematicBicycle().init(params, terrain, state)

    def propose(self, params, vehicle, terrain, features, history, state, command):
        return KinematicBicycle().step(params, terrain, history, state, command)


TRANSFORMER = Transformer(replace(TINY, layers=1))
MODEL = VertiWM(TRANSFORMER, Bicycle())
SPECIALISTS = {"transformer": Alone(TRANSFORMER), "nesam": KinematicBicycle()}
KEYS = jax.random.split(jax.random.key(0), 4)


def seeing(key, **more):
    """Encoders none of whose weights is zero."""
    encoders = replace(init_pair(key), **more)
    scale = jax.random.uniform(key, (), minval=0.02, maxval=0.06)
    return jax.tree.map(
        lambda x: x + scale * jnp.cos(jnp.arange(x.size)).reshape(x.shape), encoders
    )


UNTRAINED = VertiWMParams(
    encoders=(seeing(KEYS[0], reduce=init_reduce(KEYS[1], TINY.channels)), seeing(KEYS[3])),
    vehicle=load_vehicle(),
    transformer=moved(jax.jit(TRANSFORMER.init_params)(KEYS[0], CONSTANTS)),
    nesam=bicycle_of(load_vehicle()),
    gate=GateParams.untrained(KEYS[2], "mean", 1),
)
PARAMS = replace(UNTRAINED, gate=moved(UNTRAINED.gate))
PARTS = {"transformer": PARAMS, "nesam": PARAMS.nesam}
"""Parameters of each specialist alone."""


STATE, CONTROL = driving(1), commands(12)
COMMAND = jax.tree.map(lambda x: x[0], CONTROL)


@partial(jax.jit, static_argnames="model")
def init(params, terrain, state, model=MODEL):
    return model.init(params, terrain, state)


@partial(jax.jit, static_argnames="model")
def step(params, terrain, history, state, command, model=MODEL):
    return model.step(params, terrain, history, state, command)


@partial(jax.jit, static_argnames="model")
def alone(params, terrain, state, commands, model):
    """The states of a rollout of one specialist."""
    history = model.init(params, terrain, state)
    return rollout(model, params, terrain, state, commands, history)


def fuse(params, terrain, state, commands, model=MODEL):
    """The states of a rollout, and every coefficient of it, `[T, 4]`."""

    def advance(carry, command):
        state, history = model.step(params, terrain, carry[1], carry[0], command)
        return (state, history), (state, history.coefficients)

    start = state, model.init(params, terrain, state)
    return jax.lax.scan(advance, start, commands)[1]


fused = partial(jax.jit, static_argnames="model")(fuse)


def with_outputs(outputs):
    """Parameters of a gate that gives `outputs`, whatever it sees."""
    network = jax.tree.map(jnp.zeros_like, PARAMS.gate.network)
    network["params"]["Dense_2"]["bias"] = jnp.asarray([outputs], jnp.float32)
    return replace(PARAMS, gate=replace(PARAMS.gate, network=network))


@pytest.mark.parametrize(("terrain", "parameters"), [("mean", 33_764), ("both", 37_220)])
def test_gate_has_the_parameters_of_the_paper(terrain, parameters):
    gate = jax.eval_shape(lambda key: GateParams.untrained(key, terrain, 1), KEYS[2])
    assert count(gate.network) == parameters


@pytest.mark.parametrize(("alpha", "specialist"), [(0, "transformer"), (1, "nesam")])
def test_all_of_one_specialist_is_that_specialist(alpha, specialist):
    """A whole rollout, so each has its history and sees the fused state as if it were alone."""
    params = with_outputs(np.full(4, np.arctanh((alpha - 0.5) / 1.5)))
    together, _ = fused(params, TERRAIN, STATE, CONTROL)
    model = SPECIALISTS[specialist]
    expected = alone(PARTS[specialist], TERRAIN, STATE, CONTROL, model=model)
    np.testing.assert_allclose(together.vector, expected.vector, atol=2e-4)


def test_an_untrained_gate_takes_the_middle_of_both():
    runs = (
        fused(UNTRAINED, TERRAIN, STATE, CONTROL)[0],
        *(alone(PARTS[x], TERRAIN, STATE, CONTROL, model=SPECIALISTS[x]) for x in PARTS),
    )
    together, one, other = (jax.tree.map(lambda x: x[0], run) for run in runs)
    for of in (lambda state: motion.increment(STATE, state), motion.twist):
        np.testing.assert_allclose(of(together), 0.5 * (of(one) + of(other)), atol=1e-5)


def test_both_see_the_fused_state_through_their_own_encoders():
    after, history = step(PARAMS, TERRAIN, init(PARAMS, TERRAIN, STATE), STATE, COMMAND)
    for seen, pair in zip(history.features, PARAMS.encoders, strict=True):
        (expected,) = jax.jit(perceive)((pair,), TERRAIN, after)
        # A pixel on a border between classes may fall to its other side.
        np.testing.assert_allclose(seen.average, expected.average, atol=1e-3)
    assert np.abs(history.features[0].average - history.features[1].average).max() > 0.01


def test_one_pair_of_encoders_is_that_of_both():
    """With the same weights for both it is the same model."""
    first, _ = PARAMS.encoders
    alike, shared = replace(PARAMS, encoders=(first, first)), replace(PARAMS, encoders=(first,))
    expected, expected_alphas = fused(alike, TERRAIN, STATE, CONTROL)
    states, alphas = fused(shared, TERRAIN, STATE, CONTROL)
    # In the first six steps: after them, roundings have grown.
    np.testing.assert_allclose(alphas[:6], expected_alphas[:6], atol=1e-5)
    begun, expected = (jax.tree.map(lambda x: x[:6], each) for each in (states, expected))
    chex.assert_trees_all_close(begun, expected, atol=1e-4)
    assert np.max(np.abs(alphas - fused(PARAMS, TERRAIN, STATE, CONTROL)[1])) > 1e-3


def test_latents_are_kept_for_policies_and_change_nothing():
    model = replace(MODEL, latents=True)
    expected, expected_alphas = fused(PARAMS, TERRAIN, STATE, CONTROL)
    states, alphas = fused(PARAMS, TERRAIN, STATE, CONTROL, model=model)
    np.testing.assert_allclose(alphas, expected_alphas, atol=1e-4)
    chex.assert_trees_all_close(states, expected, atol=1e-3)
    first, second = init(PARAMS, TERRAIN, STATE, model=model).features
    assert first.latents.shape == (16, 16, 36) and second.latents is None


def test_all_encoders_look_at_once(monkeypatch):
    looks = []
    monkeypatch.setattr(verti_wm, "perceive", lambda *args: looks.append(args) or perceive(*args))
    history = jax.eval_shape(MODEL.init, PARAMS, TERRAIN, STATE)
    looks.clear()
    jax.eval_shape(MODEL.step, PARAMS, TERRAIN, history, STATE, COMMAND)
    assert len(looks) == 1


def test_coefficients_are_in_the_history_and_vary_along_a_drive():
    _, alphas = fused(PARAMS, TERRAIN, STATE, CONTROL)
    assert alphas.shape == (12, 4)
    assert bool(jnp.all((alphas > -1) & (alphas < 2))) and float(jnp.ptp(alphas, 0).min()) > 1e-2
    start = init(PARAMS, TERRAIN, STATE)
    np.testing.assert_array_equal(start.coefficients, 0.5)
    np.testing.assert_array_equal(start.hidden, 0)


def test_disagreement_is_how_far_apart_the_proposals_are():
    history = init(PARAMS, TERRAIN, STATE)
    assert disagreement(history) == 0
    first = jax.tree.map(lambda x: x[:1], CONTROL)
    ends = [alone(PARTS[name], TERRAIN, STATE, first, SPECIALISTS[name]) for name in PARTS]
    _, history = step(PARAMS, TERRAIN, history, STATE, COMMAND)
    apart = np.linalg.norm(ends[0].position[0] - ends[1].position[0])
    assert apart > 1e-3
    # Of increments, which for turning bodies are not quite straight lines.
    np.testing.assert_allclose(disagreement(history), apart, rtol=2e-2)


def test_several_gates_fuse_by_the_mean_of_their_coefficients():
    """Each remembers for itself; what they differ by spreads where the vehicle might go."""
    others = [moved(UNTRAINED.gate, seed) for seed in (1, 2, 3)]
    many = replace(PARAMS, gate=others[0].beside(*others[1:]))
    assert len(many.gate) == 3
    alone = [replace(PARAMS, gate=many.gate.only(number)) for number in range(3)]
    chex.assert_trees_all_equal(alone[1].gate.network, others[1].network)
    history = init(many, TERRAIN, STATE)
    assert history.hidden.shape == (3, 64) and history.spread == 0
    ends = [step(each, TERRAIN, init(each, TERRAIN, STATE), STATE, COMMAND) for each in alone]
    _, fused = step(many, TERRAIN, history, STATE, COMMAND)
    alphas = jnp.stack([history.coefficients for _, history in ends])
    np.testing.assert_allclose(fused.coefficients, alphas.mean(0), atol=1e-5)
    hidden = jnp.concatenate([history.hidden for _, history in ends])
    np.testing.assert_allclose(fused.hidden, hidden, atol=1e-5)
    places = np.stack([state.position for state, _ in ends])
    spread = np.linalg.norm(places.std(0))
    assert spread > 1e-3 and ends[0][1].spread == 0
    np.testing.assert_allclose(fused.spread, spread, rtol=2e-2)


def test_gates_are_added_to_those_there_are():
    config = ModelConfig(gates=3)
    one = jax.eval_shape(
        lambda key: ModelConfig().init_params(key, chrono_like(load_vehicle())), KEYS[0]
    )
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), one)
    more = config.with_gates(zeros, KEYS[1])
    assert len(more.gate) == 3
    chex.assert_trees_all_equal(more.gate.only(0), zeros.gate)
    first, second = (more.gate.only(number).network for number in (1, 2))
    kernels = [gate["params"]["Dense_0"]["kernel"] for gate in (first, second)]
    assert np.all(np.std(kernels, axis=0).mean() > 1e-2)
    assert config.with_gates(more, KEYS[1]) is more


def test_a_scalar_gate_has_one_coefficient():
    model = replace(MODEL, coefficients="scalar")
    _, alphas = fused(PARAMS, TERRAIN, STATE, CONTROL, model=model)
    np.testing.assert_array_equal(alphas, np.repeat(alphas[:, :1], 4, axis=1))
    assert np.ptp(alphas[:, 0]) > 1e-3
    constant = with_outputs([0.1, 0.2, 0.3, 0.6])
    _, alphas = fused(constant, TERRAIN, STATE, CONTROL, model=model)
    np.testing.assert_allclose(alphas, 0.5 + 1.5 * np.tanh(0.3), rtol=1e-5)


def first_coefficients(params, terrain=TERRAIN, state=STATE, **changes):
    history = replace(init(params, terrain, state), **changes)
    return step(params, terrain, history, state, COMMAND)[1].coefficients


def test_the_gate_remembers():
    hidden = jnp.linspace(-0.5, 0.5, 64)[None]
    change = first_coefficients(PARAMS) - first_coefficients(PARAMS, hidden=hidden)
    assert float(jnp.abs(change).min()) > 1e-3


def test_constants_bring_the_context_to_unit_size():
    """Place and heading are left out at first; a mean and a scale are a change of units."""
    far = replace(STATE, position=STATE.position + jnp.array([3.0, -2.0, 0.0]))
    level = rough(elevation=np.full((49, 49), 4.0), semantic=np.full((12, 12), 9))
    gate = PARAMS.gate
    everywhere = replace(PARAMS, gate=replace(gate, scale=jnp.ones_like(gate.scale)))
    here, there = (first_coefficients(PARAMS, level, state) for state in (STATE, far))
    np.testing.assert_allclose(here, there, atol=1e-4)
    here, there = (first_coefficients(everywhere, level, state) for state in (STATE, far))
    assert float(jnp.abs(here - there).max()) > 1e-2
    shifted = replace(PARAMS, gate=replace(gate, mean=gate.mean + 1))
    change = first_coefficients(shifted) - first_coefficients(PARAMS)
    assert float(jnp.abs(change).max()) > 1e-2


def test_jit_changes_nothing():
    history = init(PARAMS, TERRAIN, STATE)
    plain, plain_history = MODEL.step(PARAMS, TERRAIN, history, STATE, COMMAND)
    found, found_history = step(PARAMS, TERRAIN, history, STATE, COMMAND)
    np.testing.assert_allclose(found.vector, plain.vector, atol=2e-5)
    np.testing.assert_allclose(found_history.hidden, plain_history.hidden, atol=1e-4)
    np.testing.assert_allclose(found_history.coefficients, plain_history.coefficients, atol=1e-4)


def test_a_batch_is_a_loop_and_one_trace_serves_all_drives():
    def predict(state, control):
        return fuse(PARAMS, TERRAIN, state, control)[0]

    check_batches(predict, driving(2, 3), commands(12, 3), 1e-3)


def test_proposals_reach_the_fused_state_but_not_the_gate_with_gradients():
    history = init(PARAMS, TERRAIN, STATE)

    learned = PARAMS.transformer, PARAMS.gate

    @jax.jit
    def along(direction):
        def after(learned):
            params = replace(PARAMS, transformer=learned[0], gate=learned[1])
            state, history_ = MODEL.step(params, TERRAIN, history, STATE, COMMAND)
            return state.vector, history_.coefficients

        return jax.jvp(after, (learned,), (direction,))[1]

    transformer, gate = jax.tree.map(jnp.zeros_like, learned)
    network = jax.tree.map(jnp.ones_like, PARAMS.transformer.network)
    by_proposal = replace(transformer, network=network), gate
    network = jax.tree.map(jnp.ones_like, PARAMS.gate.network)
    by_gate = transformer, replace(gate, network=network)
    ones = jnp.ones_like(PARAMS.gate.mean)
    by_constants = transformer, replace(gate, mean=ones, scale=ones)
    moves = [[bool(np.any(x)) for x in along(d)] for d in (by_proposal, by_gate, by_constants)]
    assert moves == [[True, False], [True, True], [False, False]]


@pytest.mark.integration
def test_gate_learns_through_time_with_finite_gradients():
    """Sixteen steps, through the fused states as well as the gate's memory."""
    history, control = init(PARAMS, TERRAIN, STATE), commands(16, seed=2)

    def loss(gate, state):
        states = rollout(MODEL, replace(PARAMS, gate=gate), TERRAIN, state, control, history)
        return jnp.sum((states.position[-1] - 3.0) ** 2)

    by_gate, by_state = jax.jit(jax.grad(loss, argnums=(0, 1)))(PARAMS.gate, STATE)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((by_gate, by_state)))
    assert all(np.any(x) for x in jax.tree.leaves(by_gate.network))
    assert np.any(by_state.velocity)
