import jax.numpy as jnp
import numpy as np
from learning.recordings import STEPS, drives, write

from vertiwm_jax.learning import calibration, dataset
from vertiwm_jax.state import VehicleState
from vertiwm_jax.world_model import motion


def loaded(folder, **changes):
    write(folder, **changes)
    return dataset.load_drives(folder, "train")[0]


def test_valid_steps_have_zero_mean_and_unit_deviation(tmp_path):
    rng = np.random.default_rng(0)
    state = drives()["state"]
    state[..., 3:] += rng.normal(0.3, 0.2, state[..., 3:].shape)
    control = rng.normal([2.0, 0.1], [0.5, 0.05], (25, STEPS, 2))
    length = np.full(25, STEPS, np.int32)
    length[3] = 10
    state[3, 11:], control[3, 10:] = 1e4, 1e4
    recorded = loaded(tmp_path, state=state, control=control, length=length)
    constants = calibration.normalization(recorded)
    valid = np.arange(STEPS + 1) <= recorded.length[:, None]
    states = jnp.asarray(recorded.state)[valid][:, [3, 4, 6, 7, 8, 9, 10, 11]]
    normalized = (states - constants.state_mean) / constants.state_deviation
    np.testing.assert_allclose(normalized.mean(0), 0, atol=1e-4)
    np.testing.assert_allclose(normalized.std(0), 1, rtol=1e-4)
    commands = jnp.asarray(recorded.control)[valid[:, 1:]]
    commands = (commands - constants.command_mean) / constants.command_deviation
    np.testing.assert_allclose(commands.mean(0), 0, atol=1e-4)
    np.testing.assert_allclose(commands.std(0), 1, rtol=1e-4)
    before, after = (
        VehicleState.from_vector(jnp.asarray(x)[valid[:, 1:]])
        for x in (recorded.state[:, :-1], recorded.state[:, 1:])
    )
    transitions = motion.transition(before, after)
    np.testing.assert_allclose(transitions.mean(0), constants.transition_mean, atol=1e-4)
    np.testing.assert_allclose(transitions.std(0), constants.transition_deviation, rtol=1e-4)


def test_what_never_changes_is_left_in_its_units(tmp_path):
    constants = calibration.normalization(loaded(tmp_path))
    assert constants.state_deviation[0] == 1
    assert constants.command_deviation[1] == 1
    assert constants.state_deviation[2] < 1
    assert constants.transition_deviation[11] == 1
