import jax.numpy as jnp
import numpy as np
from learning.recordings import STEPS, drives, write

from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.normalisation import Normalisation


def loaded(folder, **changes):
    write(folder, **changes)
    return dataset.load(folder, "train")[0]


def test_valid_steps_have_zero_mean_and_unit_deviation(tmp_path):
    rng = np.random.default_rng(0)
    state = drives()["state"]
    state[..., 3:] += rng.normal(0.3, 0.2, state[..., 3:].shape)
    control = rng.normal([2.0, 0.1], [0.5, 0.05], (25, STEPS, 2))
    length = np.full(25, STEPS, np.int32)
    length[3] = 10
    state[3, 11:], control[3, 10:] = 1e4, 1e4
    recorded = loaded(tmp_path, state=state, control=control, length=length)
    constants = Normalisation.of(recorded)
    valid = np.arange(STEPS + 1) <= recorded.length[:, None]
    normalised = np.asarray(constants.state(jnp.asarray(recorded.state)))[valid]
    assert normalised.shape[1] == 8
    np.testing.assert_allclose(normalised.mean(0), 0, atol=1e-4)
    np.testing.assert_allclose(normalised.std(0), 1, rtol=1e-4)
    commands = np.asarray(constants.command(jnp.asarray(recorded.control)))[valid[:, 1:]]
    np.testing.assert_allclose(commands.mean(0), 0, atol=1e-4)
    np.testing.assert_allclose(commands.std(0), 1, rtol=1e-4)


def test_neither_place_nor_heading_matters(tmp_path):
    constants = Normalisation.of(loaded(tmp_path))
    state = np.random.default_rng(0).normal(size=12)
    moved = state + np.where(np.isin(np.arange(12), [0, 1, 2, 5]), 7.0, 0.0)
    np.testing.assert_array_equal(constants.state(state), constants.state(moved))


def test_what_never_changes_is_left_in_its_units(tmp_path):
    constants = Normalisation.of(loaded(tmp_path))
    assert constants.state_deviation[0] == 1
    assert constants.command_deviation[1] == 1
    assert constants.state_deviation[2] < 1
