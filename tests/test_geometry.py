import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vertiwm_jax import geometry

EPSILON = float(np.finfo(np.float32).eps)

exp_matrix = jax.jit(lambda xi: geometry.exp(xi).as_matrix())
log_exp = jax.jit(lambda xi: geometry.log(geometry.exp(xi)))
log_exp_jacobian = jax.jit(jax.jacfwd(lambda xi: geometry.log(geometry.exp(xi))))
rpy_matrix = jax.jit(lambda rpy: geometry.rotation_from_rpy(rpy).as_matrix())
rpy_there_and_back = jax.jit(
    lambda rpy: geometry.rpy_from_rotation(geometry.rotation_from_rpy(rpy))
)
wrap = jax.jit(geometry.wrap)

coordinate = st.floats(-1, 1, width=32)
direction = (
    st.tuples(coordinate, coordinate, coordinate)
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: np.asarray(v) / np.linalg.norm(v))
)
bounded = settings(max_examples=60, deadline=None)


def reference_exp(xi: np.ndarray) -> np.ndarray:
    """The matrix exponential of the float32 tangent, in float64."""
    x, y, z = np.float64(xi[3:])
    twist = np.zeros((4, 4))
    twist[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    twist[:3, 3] = xi[:3]
    return scipy.linalg.expm(twist)


def tangent(v: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    return np.concatenate([v, angle * axis]).astype(np.float32)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-4, 1e-3, 3e-3, 1e-2, 0.099, 0.101, 1.0, 3.0])
def test_exp_is_exact_to_rounding_at_every_angle(angle):
    rng = np.random.default_rng(0)
    for _ in range(20):
        axis = rng.normal(size=3)
        xi = tangent(rng.uniform(-1, 1, size=3), axis / np.linalg.norm(axis), angle)
        np.testing.assert_allclose(exp_matrix(xi), reference_exp(xi), rtol=0, atol=5 * EPSILON)


@bounded
@given(v=direction, axis=direction, exponent=st.floats(-6, np.log10(3.1)))
def test_exp_agrees_with_scipy(v, axis, exponent):
    xi = tangent(v, axis, 10**exponent)
    np.testing.assert_allclose(exp_matrix(xi), reference_exp(xi), rtol=0, atol=5 * EPSILON)


@bounded
@given(v=direction, axis=direction, exponent=st.floats(-6, np.log10(3.0)))
def test_log_inverts_exp(v, axis, exponent):
    xi = tangent(v, axis, 10**exponent)
    # The quaternion's rounding grows by up to angle / (pi - angle) near half a turn.
    np.testing.assert_allclose(log_exp(xi), xi, rtol=0, atol=1e-5)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 1e-3, 3e-3, 1e-2, 0.1])
def test_the_jacobian_of_log_exp_is_the_identity(angle):
    xi = tangent(np.array([0.4, 0.1, -0.05]), np.array([0.6, 0.0, 0.8]), angle)
    np.testing.assert_allclose(log_exp_jacobian(xi), np.eye(6), rtol=0, atol=1e-5)


def test_exp_has_finite_gradients_at_zero():
    jacobian = jax.jit(jax.jacrev(lambda xi: geometry.exp(xi).as_matrix()))(jnp.zeros(6))
    assert np.isfinite(jacobian).all()
    # d translation / d v at the identity.
    np.testing.assert_allclose(jacobian[:3, 3, :3], np.eye(3), atol=EPSILON)


def test_exp_is_batched():
    xi = np.random.default_rng(1).uniform(-1, 1, size=(3, 2, 6)).astype(np.float32)
    expected = np.reshape([reference_exp(x) for x in xi.reshape(-1, 6)], (3, 2, 4, 4))
    np.testing.assert_allclose(exp_matrix(xi), expected, rtol=0, atol=5 * EPSILON)


@bounded
@given(roll=st.floats(-3.1, 3.1), pitch=st.floats(-1.5, 1.5), yaw=st.floats(-3.1, 3.1))
def test_roll_pitch_yaw_agree_with_scipy(roll, pitch, yaw):
    rpy = np.array([roll, pitch, yaw], np.float32)
    expected = Rotation.from_euler("ZYX", np.float64(rpy[::-1])).as_matrix()
    np.testing.assert_allclose(rpy_matrix(rpy), expected, rtol=0, atol=5 * EPSILON)
    # Roll and yaw lose digits as pitch nears a right angle: by 1 / cos(1.5) = 14.
    error = geometry.wrap(rpy_there_and_back(rpy) - rpy)
    np.testing.assert_allclose(error, 0, atol=3e-5)


@pytest.mark.parametrize("pitch", [-np.pi / 2, np.pi / 2])
def test_pitch_is_finite_when_the_nose_points_straight_down_or_up(pitch):
    yaw = np.linspace(-3, 3, 1001, dtype=np.float32)
    rpy = np.stack([0.3 * yaw, np.full_like(yaw, pitch), yaw], axis=-1)
    back = np.asarray(rpy_there_and_back(rpy))
    np.testing.assert_allclose(back[:, 1], pitch, atol=1e-3)
    assert np.isfinite(back).all()
    slope = jax.jacfwd(rpy_there_and_back)(rpy[500])
    assert np.isfinite(slope).all()


def test_the_body_frame_points_as_the_conventions_say():
    nose_down = geometry.rotation_from_rpy(jnp.array([0.0, 0.3, 0.0]))
    assert (nose_down @ jnp.array([1.0, 0.0, 0.0]))[2] < 0
    left_side_up = geometry.rotation_from_rpy(jnp.array([0.3, 0.0, 0.0]))
    assert (left_side_up @ jnp.array([0.0, 1.0, 0.0]))[2] > 0
    turned_left = jaxlie.SE3.from_rotation_and_translation(
        geometry.rotation_from_rpy(jnp.array([0, 0, jnp.pi / 2])), jnp.array([1.0, 2.0, 3.0])
    )
    np.testing.assert_allclose(turned_left @ jnp.array([1.0, 0.0, 0.0]), [1, 3, 3], atol=1e-6)


@bounded
@given(st.floats(-100, 100, width=32))
def test_wrap_keeps_the_angle_and_its_range(angle):
    wrapped = float(wrap(angle))
    assert -np.pi - 1e-6 <= wrapped <= np.pi + 1e-6
    # One rounding of the input, and one of its sum with pi.
    assert abs(np.exp(1j * wrapped) - np.exp(1j * angle)) <= 3 * EPSILON * (abs(angle) + 4)


def test_wrap_maps_half_a_turn_to_minus_pi():
    np.testing.assert_allclose(wrap(jnp.array([jnp.pi, -jnp.pi])), [-np.pi, -np.pi], rtol=1e-6)
    np.testing.assert_allclose(
        wrap(jnp.array([0.0, 7.0, -4.0])), [0, 7 - 2 * np.pi, 2 * np.pi - 4], atol=1e-6
    )
    np.testing.assert_allclose(jax.vmap(jax.grad(geometry.wrap))(jnp.array([0.5, 9.0])), 1.0)


def test_rotations_compose_and_rotate_as_in_scipy():
    rng = np.random.default_rng(3)
    first, second = Rotation.random(50, random_state=rng), Rotation.random(50, random_state=rng)
    ours = [
        jaxlie.SO3(jnp.asarray(np.roll(r.as_quat(), 1, axis=-1), jnp.float32))
        for r in (first, second)
    ]
    points = rng.uniform(-2, 2, (50, 3)).astype(np.float32)
    both = geometry.compose(*ours)
    np.testing.assert_allclose(both.as_matrix(), (first * second).as_matrix(), atol=5 * EPSILON)
    np.testing.assert_allclose(jnp.linalg.norm(both.wxyz, axis=-1), 1, atol=2 * EPSILON)
    np.testing.assert_allclose(
        geometry.rotate(ours[0], points), first.apply(points), atol=20 * EPSILON
    )


@bounded
@given(axis=direction, angle=st.floats(-3.1, 3.1))
def test_a_rotation_from_a_vector_is_that_of_exp(axis, angle):
    omega = np.float32(angle * axis)
    found = geometry.rotation_from_vector(jnp.asarray(omega)).as_matrix()
    np.testing.assert_allclose(found, Rotation.from_rotvec(omega).as_matrix(), atol=5 * EPSILON)


def test_a_moved_pose_is_the_product_with_the_increment():
    rng = np.random.default_rng(4)
    position, xi = rng.uniform(-5, 5, (20, 3)), rng.uniform(-1, 1, (20, 6))
    rpy = rng.uniform(-1, 1, (20, 3))
    moved, turned = geometry.moved(*(jnp.asarray(x, jnp.float32) for x in (position, rpy, xi)))
    for i in range(20):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", rpy[i]).as_matrix(), position[i]
        expected = pose @ reference_exp(xi[i])
        np.testing.assert_allclose(moved[i], expected[:3, 3], atol=2e-6)
        np.testing.assert_allclose(rpy_matrix(turned[i]), expected[:3, :3], atol=1e-6)


def test_log_is_finite_with_its_gradient_at_half_a_turn():
    half = jaxlie.SE3(jnp.array([0.0, 1.0, 0.0, 0.0, 0.3, -0.2, 0.1]))
    gradient = jax.jacfwd(lambda p: geometry.log(jaxlie.SE3(p)))(half.wxyz_xyz)
    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(geometry.log(half)[3:], [np.pi, 0, 0], atol=1e-6)
