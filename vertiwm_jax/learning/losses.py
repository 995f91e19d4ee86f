"""Losses of predictions: the paper's trajectory loss, and a one-step loss."""

import jax
import jax.numpy as jnp

from vertiwm_jax import geometry
from vertiwm_jax.config import NotNegative, Positive, settings
from vertiwm_jax.state import VehicleState
from vertiwm_jax.world_model import motion


@settings
class LossConfig:
    """The trajectory loss (Eq. 9)."""

    epsilon: Positive = 1e-3
    """Error, m or rad, below which the loss turns from linear to quadratic."""
    coefficient_change: NotNegative = 0.01
    """Weight of the change of fusion coefficients between steps (the paper's lambda_alpha)."""
    velocity: NotNegative = 0.0
    """Weight of velocity (m/s) and angular velocity (rad/s), which Eq. 9 leaves out."""


def trajectory_loss(
    config: LossConfig,
    predicted: VehicleState,
    recorded: VehicleState,
    coefficients: jax.Array | None = None,
) -> jax.Array:
    """Loss `[...]` of K predicted states, leaves `[..., K, 3]` (Eq. 9).

    coefficients: `[..., K, 4]` fusion coefficients of the K steps, K at least 2, if the model has
    any. Horizontal position, height, roll and pitch, and yaw each give e^2 / (sg(e) + epsilon).
    """
    position = predicted.position - recorded.position
    turn = geometry.wrap(predicted.rpy - recorded.rpy)
    groups = [position[..., :2], position[..., 2:], turn[..., :2], turn[..., 2:]]
    loss = sum(_relative(group, config.epsilon) for group in groups)
    if config.velocity:
        velocity = predicted.velocity - recorded.velocity
        spin = predicted.angular_velocity - recorded.angular_velocity
        fast = _relative(velocity, config.epsilon) + _relative(spin, config.epsilon)
        loss = loss + config.velocity * fast
    total = jnp.mean(loss, axis=-1)
    if coefficients is not None:
        assert coefficients.shape[-2] >= 2, coefficients.shape
        change = jnp.sum(jnp.diff(coefficients, axis=-2) ** 2, axis=-1)
        total = total + config.coefficient_change * jnp.mean(change, axis=-1)
    return total


def _relative(error: jax.Array, epsilon: float) -> jax.Array:
    """`[..., n]` components to `[...]` e^2 / (sg(e) + epsilon), e their Euclidean length."""
    # The square is a sum of squares: a square of the length would have no gradient at 0.
    square = jnp.sum(error**2, axis=-1)
    return square / (jnp.sqrt(jax.lax.stop_gradient(square)) + epsilon)


def step_loss(
    deviation: jax.Array, state: VehicleState, predicted: VehicleState, recorded: VehicleState
) -> jax.Array:
    """Mean squared error `[...]` of one step from `state`, leaves `[..., 3]`.

    It compares the twelve components of `motion.transition` (the pose increment and the changes of
    velocity in the body frame), each divided by its `[12]` standard deviation over drives. So it
    depends neither on position nor on heading.
    """
    error = motion.transition(state, predicted) - motion.transition(state, recorded)
    return jnp.mean((error / deviation) ** 2, axis=-1)
