import numpy as np
from viewing.scenes import STEPS, bare, scene

from vertiwm_jax.viewing.scene import FUSION, TILT, panels


def test_panels_hold_what_is_known():
    shown, full = panels(scene()), scene()
    assert full.prediction is not None and full.wheels is not None
    assert all(len(line) == STEPS + 1 for lines in shown.values() for line in lines.values())
    np.testing.assert_allclose(np.radians(shown[TILT]["pitch"]), full.state[:, 4], atol=1e-6)
    np.testing.assert_allclose(shown["speed [m/s]"]["commanded"][:-1], full.command[:, 0])
    sinkage = np.stack(list(shown["wheel sinkage [mm]"].values()), axis=1)
    np.testing.assert_allclose(sinkage, 1000 * np.maximum(full.wheels.wheel_sinkage, 0))
    # Steps 5 to 16 are predicted, 0.1 m off in each direction.
    error, alpha = shown["position error [m]"]["position error"], shown[FUSION]["yaw"]
    known = np.isin(np.arange(STEPS + 1), np.arange(5, 17))
    np.testing.assert_allclose(error[known], 0.1 * np.sqrt(3), rtol=1e-4)
    assert np.isnan(error[~known]).all() and np.isnan(alpha[~known]).all()
    np.testing.assert_allclose(alpha[11:17], full.prediction.coefficients[1, :, 3], rtol=1e-6)
    assert set(panels(bare())) == {TILT, "speed [m/s]"}


def test_wheels_steer_and_turn():
    full = scene()
    np.testing.assert_allclose(full.steering[:-1, 0], full.command[:, 1])
    np.testing.assert_allclose(full.steering[:, 2:], 0)
    np.testing.assert_allclose(np.diff(full.turned, axis=0), 0.5)
    assert not bare().turned.any()
