from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from world_model.examples import commands, driving

from vertiwm_jax.state import VehicleState
from vertiwm_jax.world_model import fusion, motion
from vertiwm_jax.world_model.fusion import CONTEXT_SIZE, Proposal
from vertiwm_jax.world_model.perception import Perception


def perception(seed: int) -> Perception:
    elevation, semantic = np.random.default_rng(seed).normal(size=(2, 16, 16, 18))
    return Perception(jnp.asarray(elevation, jnp.float32), jnp.asarray(semantic, jnp.float32))


def proposed(state: VehicleState, seed: int, size: float = 0.2) -> VehicleState:
    xi, nu = np.random.default_rng(seed).normal(size=(2, 6))
    step = jnp.asarray(size * xi, jnp.float32)
    return motion.moved(state, step, motion.twist(state) + jnp.asarray(size * nu, jnp.float32))


STATE, COMMAND = driving(), jax.tree.map(lambda x: x[0], commands(1))
BY_TRANSFORMER, BY_NESAM = proposed(STATE, 1), proposed(STATE, 2)
TRANSFORMER = Proposal.of(STATE, BY_TRANSFORMER, perception(1))
NESAM = Proposal.of(STATE, BY_NESAM, perception(2))


@pytest.mark.parametrize("place", [0.0, 60.0])
@pytest.mark.parametrize("size", [0.0, 1e-5, 1e-3, 0.2, 1.0])
def test_zero_gives_the_transformer_and_one_nesam(size, place):
    state = replace(STATE, position=STATE.position + place)
    nexts = [proposed(state, seed, size) for seed in (1, 2)]
    proposals = [Proposal.of(state, n, perception(0)) for n in nexts]
    for alpha, expected in enumerate(nexts):
        found = fusion.fuse(state, *proposals, jnp.full(4, float(alpha)))
        # One unit in the last place of 60 m is 4 micrometres.
        np.testing.assert_allclose(found.position, expected.position, rtol=2e-7, atol=5e-7)
        np.testing.assert_allclose(found.rpy, expected.rpy, atol=1e-6)
        np.testing.assert_allclose(found.velocity, expected.velocity, atol=1e-6)
        np.testing.assert_allclose(found.angular_velocity, expected.angular_velocity, atol=1e-6)


@pytest.mark.parametrize(("group", "coordinates"), [(0, (0, 1)), (1, (2,)), (2, (3, 4)), (3, (5,))])
def test_a_coefficient_moves_its_own_coordinates(group, coordinates):
    alpha = jnp.zeros(4).at[group].set(0.7)
    fused = fusion.fuse(STATE, TRANSFORMER, NESAM, alpha)
    beta = np.where(np.isin(np.arange(6), coordinates), 0.7, 0.0)
    np.testing.assert_allclose(fusion.weights(alpha), beta, atol=1e-7)
    found = motion.increment(STATE, fused), motion.twist(fused)
    for one, a, b in zip(
        found, (TRANSFORMER.increment, TRANSFORMER.twist), (NESAM.increment, NESAM.twist),
        strict=True,
    ):  # fmt: skip
        np.testing.assert_allclose(one, a + beta * (b - a), atol=2e-6)


def test_coefficients_extrapolate_within_bounds():
    outputs = jnp.array([0.0, 50.0, -50.0, 0.5])
    expected = [0.5, 2.0, -1.0, 0.5 + 1.5 * np.tanh(0.5)]
    np.testing.assert_allclose(fusion.coefficients(outputs), expected, rtol=1e-6)


@pytest.mark.parametrize("terrain", ["mean", "both"])
def test_context_is_in_the_order_of_the_paper(terrain):
    found = fusion.context(STATE, COMMAND, TRANSFORMER, NESAM, terrain)
    averages = [
        np.concatenate([np.mean(z, (0, 1)) for z in (p.elevation, p.semantic)])
        for p in (perception(2), perception(1))
    ]
    features = np.concatenate(averages) if terrain == "both" else np.mean(averages, axis=0)
    xi_n, xi_t = NESAM.increment, TRANSFORMER.increment
    parts = [features, STATE.vector, COMMAND.vector, xi_n, xi_t, xi_n - xi_t]
    assert found.shape == (CONTEXT_SIZE[terrain],)
    np.testing.assert_allclose(found, np.concatenate(parts), atol=1e-6)


def test_position_and_yaw_are_where_they_are_said_to_be():
    other = replace(STATE, position=STATE.position + 1, rpy=STATE.rpy.at[2].add(1))
    a, b = (fusion.context(s, COMMAND, TRANSFORMER, NESAM, "mean") for s in (STATE, other))
    assert set(np.flatnonzero(a != b) - 68) == set(fusion.POSITION_AND_YAW)


def test_proposals_enter_the_context_as_given_and_the_fused_state_with_gradients():
    def proposals(by_transformer, by_nesam):
        first = Proposal.of(STATE, by_transformer, perception(1))
        return first, Proposal.of(STATE, by_nesam, perception(2))

    @jax.jit
    @jax.grad
    def by_context(nexts):
        return jnp.sum(fusion.context(STATE, COMMAND, *proposals(*nexts), "mean") ** 2)

    @jax.jit
    @jax.grad
    def by_fusion(nexts):
        return jnp.sum(fusion.fuse(STATE, *proposals(*nexts), jnp.full(4, 0.3)).vector ** 2)

    nexts = (BY_TRANSFORMER, BY_NESAM)
    assert not any(np.any(x) for x in jax.tree.leaves(by_context(nexts)))
    assert all(np.any(x) for x in jax.tree.leaves(by_fusion(nexts)))


def test_gradients_are_finite_where_both_stand_still():
    @jax.jit
    @jax.grad
    def slope(alpha, nexts):
        proposals = [Proposal.of(STATE, n, perception(0)) for n in nexts]
        return jnp.sum(fusion.fuse(STATE, *proposals, alpha).vector)

    assert np.isfinite(slope(jnp.full(4, 0.5), (STATE, STATE))).all()

    @jax.jit
    @jax.grad
    def by_nexts(nexts):
        proposals = [Proposal.of(STATE, n, perception(0)) for n in nexts]
        return jnp.sum(fusion.fuse(STATE, *proposals, jnp.full(4, 0.5)).vector)

    gradients = jax.tree.leaves(by_nexts((STATE, STATE)))
    assert all(np.isfinite(x).all() for x in gradients)
