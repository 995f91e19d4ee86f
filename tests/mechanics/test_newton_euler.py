import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vertiwm_jax.mechanics.newton_euler import (
    ContactForce,
    DampedForce,
    Shaft,
    Twist,
    _solve_spd,
    advance_twist,
    turned,
    velocity_at,
)
from vertiwm_jax.vector import Axes, Vector

MASS, INERTIA = 2500.0, np.array([1400.0, 4100.0, 5000.0])


def vector(values: np.ndarray) -> Vector:
    return Vector.of(jnp.asarray(values, jnp.float32))


def array(v: Vector) -> np.ndarray:
    return np.asarray(v.stacked(), np.float64)


def tumble(angular: np.ndarray, seconds: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Angular momentum in the world `[T, 3]` and angular velocity `[T, 3]` of a free body."""
    inertia = vector(INERTIA)

    def step(carry: tuple[jax.Array, Twist], _: None):
        quaternion, twist = carry
        turn = jaxlie.SO3.exp(seconds * twist.angular.stacked())
        quaternion = (jaxlie.SO3(quaternion) @ turn).normalize().wxyz
        twist = turned(twist, inertia, Axes.from_quaternion(turn.wxyz))
        w = twist.angular
        momentum = Vector(inertia.x * w.x, inertia.y * w.y, inertia.z * w.z)
        world = Axes.from_quaternion(quaternion).to_world(momentum)
        return (quaternion, twist), (world.stacked(), w.stacked())

    start = (jnp.array([1.0, 0, 0, 0]), Twist(vector(np.zeros(3)), vector(angular)))
    _, (momentum, omega) = jax.lax.scan(step, start, None, length=steps)
    return np.asarray(momentum), np.asarray(omega)


@pytest.mark.parametrize("seed", range(3))
def test_step_solves_the_dense_system(seed):
    rng = np.random.default_rng(seed)
    seconds, gravity = 0.02, np.array([0.5, -1.0, -9.7])
    linear, angular = rng.normal(size=3), rng.normal(size=3)
    contacts, matrix = [], np.diag([MASS] * 3 + list(INERTIA))
    force = np.concatenate([MASS * gravity, np.zeros(3)])
    for count, stiff in ((4, 1e4), (4, 1e5), (1, 0.0)):
        direction = rng.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        arm, push = rng.normal(size=(count, 3)), 5000 * rng.normal(size=count)
        damping = stiff * rng.random(count)
        contacts.append(
            ContactForce.of(
                vector(arm), DampedForce(vector(direction), jnp.asarray(push), jnp.asarray(damping))
            )
        )
        jacobian = np.concatenate([direction, np.cross(arm, direction)], axis=1)
        matrix += seconds * jacobian.T @ (damping[:, None] * jacobian)
        force += jacobian.T @ push

    twist = advance_twist(
        Twist(vector(linear), vector(angular)),
        jnp.float32(MASS),
        vector(INERTIA),
        vector(gravity),
        contacts,
        seconds,
    )

    change = np.linalg.solve(matrix, seconds * force)
    np.testing.assert_allclose(array(twist.linear), linear + change[:3], atol=1e-4)
    np.testing.assert_allclose(array(twist.angular), angular + change[3:], atol=1e-4)


def test_a_shaft_is_one_more_unknown_of_the_dense_system():
    """Its spin is eliminated; here it is solved for beside the velocities."""
    rng = np.random.default_rng(0)
    seconds, inertia = 0.02, 300.0
    direction = rng.normal(size=(4, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    arm, push, grip = rng.normal(size=(4, 3)), 5000 * rng.normal(size=4), 1e4 * rng.random(4)
    jacobian = np.concatenate([direction, np.cross(arm, direction)], axis=1)
    pull = 0.4 * grip
    matrix = np.zeros((7, 7))
    matrix[:6, :6] = np.diag([MASS] * 3 + list(INERTIA))
    matrix[:6, :6] += seconds * jacobian.T @ (grip[:, None] * jacobian)
    matrix[:6, 6] = matrix[6, :6] = -seconds * jacobian.T @ pull
    matrix[6, 6] = inertia
    expected = np.linalg.solve(matrix, np.append(seconds * jacobian.T @ push, 0.0))

    along, forces = vector(direction), map(jnp.asarray, (push, grip))
    still, none = Twist(vector(np.zeros(3)), vector(np.zeros(3))), vector(np.zeros(3))
    shaft = Shaft(vector(arm), along.times(jnp.asarray(pull)), jnp.float32(inertia))
    contacts = [ContactForce.of(vector(arm), DampedForce(along, *forces))]
    twist = advance_twist(still, jnp.float32(MASS), vector(INERTIA), none, contacts, seconds, shaft)
    found = [*array(twist.linear), *array(twist.angular), shaft.gained(still, twist, seconds)]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_cholesky_solves_a_batch_of_systems():
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(7, 6, 6))
    matrices = roots @ roots.swapaxes(1, 2) + np.eye(6)
    rhs = rng.normal(size=(7, 6))
    lower = [[jnp.asarray(matrices[:, i, j]) for j in range(i + 1)] for i in range(6)]

    solution = _solve_spd(lower, [jnp.asarray(rhs[:, i]) for i in range(6)])

    expected = np.linalg.solve(matrices, rhs[..., None])[..., 0]
    np.testing.assert_allclose(np.stack(solution, axis=1), expected, rtol=1e-3, atol=1e-4)


def test_a_body_without_contacts_falls_freely():
    twist = Twist(vector(np.array([1.0, 2.0, 3.0])), vector(np.array([0.1, 0.2, 0.3])))
    gravity = vector(np.array([0.0, 0.0, -9.81]))
    after = advance_twist(twist, jnp.float32(MASS), vector(INERTIA), gravity, [], 0.1)
    np.testing.assert_allclose(array(after.linear), [1.0, 2.0, 3.0 - 0.981], rtol=1e-6)
    np.testing.assert_allclose(array(after.angular), array(twist.angular), rtol=1e-6)


def test_a_stiff_damper_stops_its_point_at_any_step_without_overshoot():
    down = vector(np.array([[0.0, 0.0, -1.0]]))
    arm = vector(np.array([[0.3, -0.2, -0.5]]))
    twist = Twist(vector(np.array([0.0, 0.0, -3.0])), vector(np.zeros(3)))
    damper = ContactForce.of(arm, DampedForce(down, -1e9 * jnp.ones(1) * 3.0, 1e9 * jnp.ones(1)))
    no_gravity = vector(np.zeros(3))
    for seconds in (0.001, 0.1):
        after = advance_twist(
            twist, jnp.float32(MASS), vector(INERTIA), no_gravity, [damper], seconds
        )
        assert abs(float(velocity_at(after, arm).dot(down)[0])) < 1e-2


def test_velocity_of_points_is_that_of_a_rigid_body():
    rng = np.random.default_rng(1)
    linear, angular, arm = rng.normal(size=3), rng.normal(size=3), rng.normal(size=(5, 3))
    velocity = velocity_at(Twist(vector(linear), vector(angular)), vector(arm))
    np.testing.assert_allclose(array(velocity), linear + np.cross(angular, arm), atol=1e-6)


def test_turning_keeps_both_momenta_in_the_world():
    rng = np.random.default_rng(2)
    linear, angular = rng.normal(size=3), rng.normal(size=3)
    turn = Rotation.from_rotvec(rng.normal(size=3))
    axes = Axes.from_quaternion(jnp.asarray(np.roll(turn.as_quat(), 1), jnp.float32))
    after = turned(Twist(vector(linear), vector(angular)), vector(INERTIA), axes)
    np.testing.assert_allclose(turn.apply(array(after.linear)), linear, atol=1e-5)
    momentum = turn.apply(INERTIA * array(after.angular))
    np.testing.assert_allclose(momentum, INERTIA * angular, rtol=1e-5, atol=1e-2)


def test_a_tumbling_body_keeps_its_momentum_and_does_not_blow_up():
    # About the middle axis: the motion that explicit gyroscopic terms turn into an explosion.
    angular = np.array([0.05, 6.0, 0.05])
    momentum, omega = tumble(angular, 0.02, 1000)
    np.testing.assert_allclose(momentum, np.tile(INERTIA * angular, (1000, 1)), rtol=0, atol=60.0)
    length = np.linalg.norm(INERTIA * omega, axis=1)
    np.testing.assert_allclose(length, np.linalg.norm(INERTIA * angular), rtol=1e-3)
    assert (omega[:, 1] < 0).any()  # It does flip (Dzhanibekov).


def test_spin_about_a_principal_axis_is_steady():
    _, omega = tumble(np.array([0.0, 0.0, 3.0]), 0.02, 200)
    np.testing.assert_allclose(omega, np.tile([0.0, 0.0, 3.0], (200, 1)), atol=1e-4)
