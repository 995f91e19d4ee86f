import jax
import jax.numpy as jnp
import numpy as np
from world_model.examples import CONSTANTS

from vertiwm_jax.world_model.normalisation import Normalisation


def test_values_are_those_of_the_definition():
    rng = np.random.default_rng(0)
    state, command, output = rng.normal(size=(3, 12)), rng.normal(size=(3, 2)), rng.normal(size=12)
    local = state[:, [3, 4, 6, 7, 8, 9, 10, 11]]
    expected = (local - CONSTANTS.state_mean) / CONSTANTS.state_deviation
    np.testing.assert_allclose(CONSTANTS.state(jnp.asarray(state)), expected, rtol=1e-5)
    expected = (command - CONSTANTS.command_mean) / CONSTANTS.command_deviation
    np.testing.assert_allclose(CONSTANTS.command(jnp.asarray(command)), expected, rtol=1e-5)
    expected = CONSTANTS.transition_mean + output * CONSTANTS.transition_deviation
    np.testing.assert_allclose(CONSTANTS.transition(jnp.asarray(output)), expected, rtol=1e-5)


def test_unit_constants_change_nothing():
    unit, vector = Normalisation.unit(), jnp.arange(12.0)
    np.testing.assert_array_equal(unit.state(vector), [3, 4, 6, 7, 8, 9, 10, 11])
    np.testing.assert_array_equal(unit.command(vector[:2]), vector[:2])
    np.testing.assert_array_equal(unit.transition(vector), vector)


def test_neither_place_nor_heading_matters():
    state = np.random.default_rng(0).normal(size=12)
    moved = state + np.where(np.isin(np.arange(12), [0, 1, 2, 5]), 7.0, 0.0)
    np.testing.assert_array_equal(CONSTANTS.state(state), CONSTANTS.state(moved))


def test_constants_do_not_learn():
    def total(constants):
        vector = jnp.arange(1.0, 13.0)
        parts = constants.state(vector), constants.command(vector[:2]), constants.transition(vector)
        return sum(jnp.sum(part) for part in parts)

    gradient = jax.grad(total)(CONSTANTS)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(gradient))
