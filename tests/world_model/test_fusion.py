from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from world_model.examples import commands, driving

from vertiwm_jax.state import VehicleState
from vertiwm_jax.world_model import fusion, motion
from vertiwm_jax.world_model.fusion import CONTEXT_SIZE


def proposed(state: VehicleState, seed: int, size: float = 0.2) -> VehicleState:
    xi, nu = np.random.default_rng(seed).normal(size=(2, 6))
    step = jnp.asarray(size * xi, jnp.float32)
    return motion.moved(state, step, motion.twist(state) + jnp.asarray(size * nu, jnp.float32))


STATE, COMMAND = driving(), jax.tree.map(lambda x: x[0], commands(1))
BY_TRANSFORMER, BY_NESAM = proposed(STATE, 1), proposed(STATE, 2)
AVERAGES = jnp.asarray(np.random.default_rng(3).normal(size=(2, 36)), jnp.float32)


def fuse(state, by_transformer, by_nesam, alpha):
    """Eqs. 3, 7 and 8."""
    beta = fusion.weights(alpha)
    xi_t, xi_n = (motion.increment(state, x) for x in (by_transformer, by_nesam))
    nu_t, nu_n = map(motion.twist, (by_transformer, by_nesam))
    return motion.moved(state, xi_t + beta * (xi_n - xi_t), nu_t + beta * (nu_n - nu_t))


def context(state, command, by_transformer, by_nesam, terrain):
    xi = (motion.increment(state, x) for x in (by_nesam, by_transformer))
    return fusion.context(terrain, *AVERAGES, state, command, *xi)


@pytest.mark.parametrize("place", [0.0, 60.0])
@pytest.mark.parametrize("size", [0.0, 1e-5, 1e-3, 0.2, 1.0])
def test_zero_gives_the_transformer_and_one_nesam(size, place):
    state = replace(STATE, position=STATE.position + place)
    nexts = [proposed(state, seed, size) for seed in (1, 2)]
    for alpha, expected in enumerate(nexts):
        found = fuse(state, *nexts, jnp.full(4, float(alpha)))
        # One unit in the last place of 60 m is 4 micrometres.
        np.testing.assert_allclose(found.position, expected.position, rtol=2e-7, atol=5e-7)
        np.testing.assert_allclose(found.rpy, expected.rpy, atol=1e-6)
        np.testing.assert_allclose(found.velocity, expected.velocity, atol=1e-6)
        np.testing.assert_allclose(found.angular_velocity, expected.angular_velocity, atol=1e-6)


@pytest.mark.parametrize(("group", "coordinates"), [(0, (0, 1)), (1, (2,)), (2, (3, 4)), (3, (5,))])
def test_a_coefficient_moves_its_own_coordinates(group, coordinates):
    alpha = jnp.zeros(4).at[group].set(0.7)
    fused = fuse(STATE, BY_TRANSFORMER, BY_NESAM, alpha)
    beta = np.where(np.isin(np.arange(6), coordinates), 0.7, 0.0)
    np.testing.assert_allclose(fusion.weights(alpha), beta, atol=1e-7)
    for of in (lambda x: motion.increment(STATE, x), motion.twist):
        a, b = of(BY_TRANSFORMER), of(BY_NESAM)
        np.testing.assert_allclose(of(fused), a + beta * (b - a), atol=2e-6)


def test_coefficients_extrapolate_within_bounds():
    outputs = jnp.array([0.0, 50.0, -50.0, 0.5])
    expected = [0.5, 2.0, -1.0, 0.5 + 1.5 * np.tanh(0.5)]
    np.testing.assert_allclose(fusion.coefficients(outputs, "grouped"), expected, rtol=1e-6)
    scalar = fusion.coefficients(outputs, "scalar")
    np.testing.assert_allclose(scalar, np.full(4, 0.5 + 1.5 * np.tanh(0.125)), rtol=1e-6)


@pytest.mark.parametrize("terrain", ["mean", "both"])
def test_context_is_in_the_order_of_the_paper(terrain):
    found = context(STATE, COMMAND, BY_TRANSFORMER, BY_NESAM, terrain)
    features = np.concatenate(AVERAGES) if terrain == "both" else np.mean(AVERAGES, axis=0)
    xi_t, xi_n = (motion.increment(STATE, x) for x in (BY_TRANSFORMER, BY_NESAM))
    parts = [features, STATE.vector, COMMAND.vector, xi_n, xi_t, xi_n - xi_t]
    assert found.shape == (CONTEXT_SIZE[terrain],)
    np.testing.assert_allclose(found, np.concatenate(parts), atol=1e-6)
    np.testing.assert_allclose(found[fusion.DIFFERENCE], xi_n - xi_t, atol=1e-6)


def test_position_and_yaw_are_where_they_are_said_to_be():
    xi = jnp.zeros((2, 6))
    other = replace(STATE, position=STATE.position + 1, rpy=STATE.rpy.at[2].add(1))
    a, b = (fusion.context("mean", *AVERAGES, s, COMMAND, *xi) for s in (STATE, other))
    assert set(np.flatnonzero(a != b) - 68) == set(fusion.POSITION_AND_YAW)


def test_proposals_enter_the_context_as_given_and_the_fused_state_with_gradients():
    @jax.jit
    @jax.grad
    def by_context(nexts):
        return jnp.sum(context(STATE, COMMAND, *nexts, "mean") ** 2)

    @jax.jit
    @jax.grad
    def by_fusion(nexts):
        return jnp.sum(fuse(STATE, *nexts, jnp.full(4, 0.3)).vector ** 2)

    nexts = (BY_TRANSFORMER, BY_NESAM)
    assert not any(np.any(x) for x in jax.tree.leaves(by_context(nexts)))
    assert all(np.any(x) for x in jax.tree.leaves(by_fusion(nexts)))


def test_gradients_are_finite_where_both_stand_still():
    def total(alpha, nexts):
        return jnp.sum(fuse(STATE, *nexts, alpha).vector)

    by_both = jax.jit(jax.grad(total, argnums=(0, 1)))(jnp.full(4, 0.5), (STATE, STATE))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(by_both))
