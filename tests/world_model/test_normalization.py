import jax
import jax.numpy as jnp
import numpy as np
from world_model.examples import CONSTANTS

from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.world_model.normalization import INPUTS, Normalization


def inputs(constants, state, command):
    state = VehicleState.from_vector(jnp.asarray(state))
    return constants.inputs(state, Command.from_vector(jnp.asarray(command)))


def test_values_are_those_of_the_definition():
    rng = np.random.default_rng(0)
    state, command, output = rng.normal(size=(3, 12)), rng.normal(size=(3, 2)), rng.normal(size=12)
    found = inputs(CONSTANTS, state, command)
    assert found.shape == (3, INPUTS)
    local = state[:, [3, 4, 6, 7, 8, 9, 10, 11]]
    expected = (local - CONSTANTS.state_mean) / CONSTANTS.state_deviation
    np.testing.assert_allclose(found[:, :8], expected, rtol=1e-5)
    expected = (command - CONSTANTS.command_mean) / CONSTANTS.command_deviation
    np.testing.assert_allclose(found[:, 8:], expected, rtol=1e-5)
    expected = CONSTANTS.transition_mean + output * CONSTANTS.transition_deviation
    np.testing.assert_allclose(CONSTANTS.transition(jnp.asarray(output)), expected, rtol=1e-5)


def test_unit_constants_change_nothing():
    unit, vector = Normalization.unit(), jnp.arange(12.0)
    expected = [3, 4, 6, 7, 8, 9, 10, 11, 0, 1]
    np.testing.assert_array_equal(inputs(unit, vector, vector[:2]), expected)
    np.testing.assert_array_equal(unit.transition(vector), vector)


def test_neither_place_nor_heading_matters():
    state, command = np.random.default_rng(0).normal(size=12), np.zeros(2)
    moved = state + np.where(np.isin(np.arange(12), [0, 1, 2, 5]), 7.0, 0.0)
    found, expected = (inputs(CONSTANTS, x, command) for x in (moved, state))
    np.testing.assert_array_equal(found, expected)


def test_constants_do_not_learn():
    def total(constants):
        vector = jnp.arange(1.0, 13.0)
        seen = inputs(constants, vector, vector[:2])
        return jnp.sum(seen) + jnp.sum(constants.transition(vector))

    gradient = jax.grad(total)(CONSTANTS)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(gradient))
