import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learning.recordings import GRASS, SNOW, STEPS, wheel_signals, write

from vertiwm_jax.learning import dataset
from vertiwm_jax.learning import windows as prediction_windows
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.learning.windows import GROUNDS, gather, index


def test_windows_hold_consecutive_steps_within_the_valid_ones(tmp_path):
    length = np.full(25, STEPS, np.int32)
    length[23] = 21
    write(tmp_path, length=length)
    loaded, terrain = dataset.load_drives(tmp_path, "test")
    windows = gather(loaded, index(loaded, terrain, context=12, horizon=8, stride=5))
    # (40 - 20) // 5 + 1 of the drives of 40 steps, one of the drive of 21.
    speeds = np.asarray(windows.state[:, 0, 6])
    np.testing.assert_allclose(np.unique(speeds, return_counts=True)[0], [3.2, 3.3, 3.4])
    assert np.unique(speeds, return_counts=True)[1].tolist() == [5, 1, 5]
    assert windows.state.shape == (11, 21, 12)
    assert windows.control.shape == (11, 20, 2)
    assert windows.context == 12
    driven = np.diff(np.asarray(windows.state[..., 0]), axis=1)
    np.testing.assert_allclose(driven, np.tile(0.1 * speeds[:, None], 20), atol=1e-5)
    starts = np.asarray(windows.state[:5, 0, 0]) / (0.1 * 3.2)
    np.testing.assert_allclose(starts, [0, 5, 10, 15, 20], atol=1e-4)


def test_ground_of_a_window_is_that_under_its_predicted_steps(tmp_path):
    classes = np.full((25, STEPS + 1, 4), GRASS, np.uint8)
    classes[23] = SNOW
    classes[24, :11] = SNOW  # Context only.
    classes[22, 15:, 0] = SNOW
    write(tmp_path, wheel_class=classes)
    loaded, terrain = dataset.load_drives(tmp_path, "test")
    windows = gather(loaded, index(loaded, terrain, context=12, horizon=8, stride=100))
    assert [GROUNDS[i] for i in windows.ground] == ["transition", "deformable", "rigid"]


def test_drives_shorter_than_a_window_are_refused(tmp_path):
    write(tmp_path)
    loaded, terrain = dataset.load_drives(tmp_path, "test")
    with pytest.raises(DataError, match="at least 60 steps, found at most 40"):
        gather(loaded, index(loaded, terrain, context=30, horizon=30))


def test_windows_hold_what_was_recorded_beside_the_states(tmp_path):
    recorded = wheel_signals()
    write(tmp_path, wheel_force=recorded["wheel_force"], steer_angle=recorded["steer_angle"])
    loaded, terrain = dataset.load_drives(tmp_path, "test")
    windows = gather(loaded, index(loaded, terrain, context=12, horizon=8, stride=20))
    force = recorded["wheel_force"][22:]
    expected = np.stack([force[d, s : s + 21] for d in range(3) for s in (0, 20)])
    np.testing.assert_array_equal(windows.wheels.wheel_force, expected)
    assert windows.wheels.steer_angle.shape == (6, 21, 2)
    assert windows.wheels.wheel_omega is None


def test_a_gathered_batch_is_those_windows_of_all(tmp_path):
    write(tmp_path, "a.npz", **wheel_signals())
    write(tmp_path, "b.npz", **wheel_signals())
    loaded, terrain = dataset.load_drives(tmp_path, "train")
    every = gather(loaded, index(loaded, terrain, context=6, horizon=4))
    places = prediction_windows.index(loaded, terrain, context=6, horizon=4)
    rows = jnp.array([300, 0, 7, 7])
    drives = jax.device_put(loaded)

    @jax.jit
    def batch(rows):
        return gather(drives, places, rows)

    jax.tree.map(
        lambda some, whole: np.testing.assert_array_equal(some, whole[rows]), batch(rows), every
    )
    assert batch(rows).world.tolist() == [1, 0, 0, 0]
