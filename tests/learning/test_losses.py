import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from vertiwm_jax.learning.losses import LossConfig, step_loss, trajectory_loss
from vertiwm_jax.state import VehicleState

K = 6


def states(seed, *batch):
    vector = np.random.default_rng(seed).normal(0, 1, (*batch, K, 12))
    return vector.astype(np.float32)


def reference(config, predicted, recorded, alpha=None):
    """Eq. 11 as it is printed, in plain NumPy and double precision, for one window."""
    total = 0.0
    for p, r in zip(predicted.astype(np.float64), recorded.astype(np.float64), strict=True):
        delta = p - r
        delta[3:6] = (delta[3:6] + np.pi) % (2 * np.pi) - np.pi
        for group, weight in (
            ([0, 1], 1),
            ([2], 1),
            ([3, 4], 1),
            ([5], 1),
            ([6, 7, 8], config.velocity),
            ([9, 10, 11], config.velocity),
        ):
            e = np.linalg.norm(delta[group])
            total += weight * e**2 / (e + config.epsilon) / len(predicted)
    if alpha is not None:
        change = np.linalg.norm(alpha[1:] - alpha[:-1], axis=-1)
        total += config.coefficient_change / (len(alpha) - 1) * (change**2).sum()
    return total


@pytest.mark.parametrize("velocity", [0.0, 0.3])
def test_trajectory_loss_is_equation_11(velocity):
    config = LossConfig(epsilon=0.05, coefficient_change=0.7, velocity=velocity)
    predicted, recorded = 3 * states(0, 2), 3 * states(1, 2)
    alpha = np.random.default_rng(2).uniform(-1, 2, (2, K, 4)).astype(np.float32)
    found = trajectory_loss(
        config, VehicleState.from_vector(predicted), VehicleState.from_vector(recorded), alpha
    )
    expected = [reference(config, *one) for one in zip(predicted, recorded, alpha, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    without = trajectory_loss(config, *map(VehicleState.from_vector, (predicted, recorded)))
    expected = [reference(config, *one) for one in zip(predicted, recorded, strict=True)]
    np.testing.assert_allclose(without, expected, rtol=1e-5)


def test_the_denominator_is_detached():
    config = LossConfig(epsilon=0.05)
    predicted, recorded = states(0), VehicleState.from_vector(jnp.zeros((K, 12)))

    def loss(vector):
        return trajectory_loss(config, VehicleState.from_vector(vector), recorded)

    gradient = jax.grad(loss)(predicted)
    e = np.linalg.norm(predicted[:, :2], axis=-1, keepdims=True)
    np.testing.assert_allclose(gradient[:, :2], 2 * predicted[:, :2] / (e + 0.05) / K, rtol=1e-5)


def test_no_error_has_no_loss_and_no_gradient():
    recorded = VehicleState.from_vector(jnp.asarray(states(0)))
    deviation = jnp.full(12, 0.1)
    config = LossConfig(velocity=1.0)
    before = VehicleState.from_vector(jnp.asarray(states(1)))
    for loss in (
        lambda x: trajectory_loss(config, x, recorded, jnp.ones((K, 4))),
        lambda x: jnp.sum(step_loss(deviation, before, x, recorded)),
    ):
        value, gradient = jax.value_and_grad(loss)(recorded)
        assert value == 0
        assert all((np.asarray(leaf) == 0).all() for leaf in jax.tree.leaves(gradient))


def test_angles_are_compared_the_short_way_round():
    near = VehicleState.from_vector(jnp.zeros((1, 12)).at[0, 5].set(np.pi - 0.1))
    far = VehicleState.from_vector(jnp.zeros((1, 12)).at[0, 5].set(-np.pi + 0.1))
    loss = trajectory_loss(LossConfig(epsilon=1e-6), near, far)
    np.testing.assert_allclose(loss, 0.2, rtol=1e-4)


def test_one_step_is_compared_in_the_body_frame_and_in_units_of_the_data():
    rng = np.random.default_rng(3)
    deviation = rng.uniform(0.1, 1, 12)
    before, predicted, recorded = (0.3 * rng.normal(size=12) for _ in range(3))

    def transform(x):
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_euler("ZYX", x[[5, 4, 3]]).as_matrix()
        matrix[:3, 3] = x[:3]
        return matrix

    def increment(after):
        relative = np.linalg.inv(transform(before)) @ transform(after)
        log = logm(relative).real
        return np.array([*log[:3, 3], log[2, 1], log[0, 2], log[1, 0]])

    change = predicted[6:] - recorded[6:]
    # The increment is compared less that of the mean velocity over 0.1 s.
    rest = increment(predicted) - increment(recorded) - 0.1 * 0.5 * change
    expected = np.mean((np.concatenate([rest, change]) / deviation) ** 2)
    arguments = (
        VehicleState.from_vector(jnp.asarray(x, jnp.float32)) for x in (before, predicted, recorded)
    )
    np.testing.assert_allclose(step_loss(deviation, *arguments), expected, rtol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"epsilon": 0.0}, "epsilon: expected more than 0"),
        ({"coefficient_change": -1.0}, "coefficient_change: expected at least 0"),
        ({"velocity": -1.0}, "velocity: expected at least 0"),
    ],
)
def test_settings_out_of_range_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        LossConfig(**change)
