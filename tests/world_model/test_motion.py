import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation
from world_model.examples import driving

from vertiwm_jax.state import VehicleState
from vertiwm_jax.world_model import motion


def matrix(state: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", state[[5, 4, 3]]).as_matrix()
    pose[:3, 3] = state[:3]
    return pose


def wedge(xi: np.ndarray) -> np.ndarray:
    x, y, z = xi[3:]
    result = np.zeros((4, 4))
    result[:3] = np.c_[[[0, -z, y], [z, 0, -x], [-y, x, 0]], xi[:3]]
    return result


@pytest.mark.parametrize("size", [1e-4, 1e-2, 0.5])
def test_a_step_is_the_matrix_exponential(size):
    state = driving(1)
    xi, nu = size * np.array([1.0, -0.3, 0.2, 0.4, 0.7, -0.5]), np.arange(6.0)
    after = motion.moved(state, jnp.asarray(xi, jnp.float32), jnp.asarray(nu, jnp.float32))
    start = np.asarray(state.vector, float)
    expected = matrix(start) @ expm(wedge(xi))
    np.testing.assert_allclose(matrix(np.asarray(after.vector, float)), expected, atol=2e-6)
    np.testing.assert_allclose(motion.twist(after), nu)


@pytest.mark.parametrize("size", [1e-4, 1e-2, 0.5])
def test_the_increment_is_the_matrix_logarithm_far_from_the_origin(size):
    rng = np.random.default_rng(0)
    before = np.float32([800, -900, 3, 0.1, -0.2, 2.5, *np.zeros(6)])
    after = np.float32(before + size * np.r_[rng.uniform(-1, 1, 6), np.zeros(6)])
    before, after = before.astype(float), after.astype(float)  # what float32 holds, exactly
    relative = logm(np.linalg.solve(matrix(before), matrix(after))).real
    expected = np.r_[relative[:3, 3], relative[2, 1], relative[0, 2], relative[1, 0]]
    found = motion.increment(*(VehicleState.from_vector(jnp.float32(x)) for x in (before, after)))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_transitions_lead_from_one_state_to_the_next():
    before = driving(1, 20)
    change = jax.random.normal(jax.random.key(0), (20, 12)) * 0.1
    after = motion.advance(before, change)
    np.testing.assert_allclose(motion.transition(before, after), change, atol=3e-6)


def test_constant_velocity_on_a_circle_is_no_transition():
    """A body that keeps its twist follows the exponential: every number is zero."""
    state = driving(2)
    after = motion.moved(state, 0.1 * motion.twist(state), motion.twist(state))
    np.testing.assert_allclose(motion.transition(state, after), 0, atol=1e-6)


def test_gradients_are_finite_at_rest():
    state = VehicleState.from_vector(jnp.zeros(12))
    gradient = jax.grad(lambda after: jnp.sum(motion.transition(state, after)))(state)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_a_correction_moves_a_state_along_the_tangent():
    """Against SciPy's matrix exponential of the twist, in double precision."""
    state, rng = driving(), np.random.default_rng(1)
    for size in (1e-3, 0.1, 1.0):
        correction = (size * rng.uniform(-1, 1, 12)).astype(np.float32)
        expected = np.asarray(state.pose.as_matrix(), np.float64)
        expected = expected @ expm(wedge(correction[:6].astype(float)))
        found = motion.corrected(state, jnp.asarray(correction))
        np.testing.assert_allclose(found.pose.as_matrix(), expected, atol=3e-6)
        np.testing.assert_allclose(found.velocity, state.velocity + correction[6:9], atol=1e-6)
        rates = state.angular_velocity + correction[9:]
        np.testing.assert_allclose(found.angular_velocity, rates, atol=1e-6)
        np.testing.assert_allclose(motion.difference(state, found), correction, atol=3e-6)
