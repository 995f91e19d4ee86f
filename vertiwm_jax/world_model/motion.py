"""One transition in the vehicle's own terms: twelve small numbers, wherever it is and faces."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie

from vertiwm_jax import geometry
from vertiwm_jax.state import STEP_SECONDS, VehicleState


def increment(before: VehicleState, after: VehicleState) -> jax.Array:
    """`[..., 6]` xi of Eq. 3, the pose after in the body frame before: tangent order, m and rad.

    Positions are subtracted before they are turned: far from the origin of the map, the inverse
    of a pose in float32 would cost more than the micrometers that matter near identity.
    """
    rotation = geometry.rotation_from_rpy(before.rpy).inverse()
    relative = jaxlie.SE3.from_rotation_and_translation(
        geometry.compose(rotation, geometry.rotation_from_rpy(after.rpy)),
        geometry.rotate(rotation, after.position - before.position),
    )
    return geometry.log(relative)


def transition(before: VehicleState, after: VehicleState) -> jax.Array:
    """`[..., 12]` from one state to the next, 0.1 s later.

    First the increment less that of the mean of both velocities, m and rad: forward, in recorded
    drives, a fifth of what constant velocity leaves. Then the changes of v_body (m/s) and
    omega_body (rad/s).
    """
    velocity = twist(before)
    change = twist(after) - velocity
    rest = increment(before, after) - STEP_SECONDS * (velocity + 0.5 * change)
    return jnp.concatenate([rest, change], axis=-1)


def advance(state: VehicleState, transition: jax.Array) -> VehicleState:
    """The next state after a `[..., 12]` transition: the inverse of `transition`."""
    rest, change = transition[..., :6], transition[..., 6:]
    velocity = twist(state)
    return moved(state, STEP_SECONDS * (velocity + 0.5 * change) + rest, velocity + change)


def twist(state: VehicleState) -> jax.Array:
    """`[..., 6]` nu, the velocity and angular velocity of the body, m/s and rad/s."""
    return jnp.concatenate([state.velocity, state.angular_velocity], axis=-1)


def moved(state: VehicleState, increment: jax.Array, twist: jax.Array) -> VehicleState:
    """The state T Exp(xi) with nu (Eq. 8): increment `[..., 6]` m and rad, twist `[..., 6]`."""
    position, rpy = geometry.moved(state.position, state.rpy, increment)
    return replace(
        state, position=position, rpy=rpy, velocity=twist[..., :3], angular_velocity=twist[..., 3:]
    )


def difference(expected: VehicleState, state: VehicleState) -> jax.Array:
    """`[..., 12]` between states: increment in the first's body frame (m, rad), then velocities."""
    change = twist(state) - twist(expected)
    return jnp.concatenate([increment(expected, state), change], axis=-1)


def corrected(state: VehicleState, correction: jax.Array) -> VehicleState:
    """A state moved by a `[..., 12]` correction: the inverse of `difference`."""
    return moved(state, correction[..., :6], twist(state) + correction[..., 6:])
