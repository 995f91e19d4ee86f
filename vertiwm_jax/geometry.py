"""SE(3) in float32: exponential, logarithm, roll-pitch-yaw and angle wrapping.

Rotations and poses are `jaxlie` groups. Tangent vectors are ordered translation first,
rotation second, as in the paper's Log (Eq. 3). Roll, pitch and yaw are
R = Rz(yaw) Ry(pitch) Rx(roll): positive pitch is nose down.
"""

import jax
import jax.numpy as jnp
import jaxlie

_LARGEST_SINE = 1 - 2**-24
"""The largest float32 below one, where the slope of the inverse sine is still finite."""


def wrap(angle: jax.Array) -> jax.Array:
    """`[...]` angles in rad, mapped to [-pi, pi)."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def rotation_from_rpy(rpy: jax.Array) -> jaxlie.SO3:
    """`[..., 3]` roll, pitch, yaw in rad to the rotation from body to world."""
    return jaxlie.SO3.from_rpy_radians(rpy[..., 0], rpy[..., 1], rpy[..., 2])


def rpy_from_rotation(rotation: jaxlie.SO3) -> jax.Array:
    """The rotation from body to world to `[..., 3]` roll, pitch, yaw in rad.

    Finite at every attitude; jaxlie's pitch is NaN where rounding lifts its sine above one.
    """
    w, x, y, z = jnp.moveaxis(rotation.wxyz, -1, 0)
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -_LARGEST_SINE, _LARGEST_SINE))
    roll, yaw = rotation.compute_roll_radians(), rotation.compute_yaw_radians()
    return jnp.stack([roll, pitch, yaw], axis=-1)


def pose_from_rpy(position: jax.Array, rpy: jax.Array) -> jaxlie.SE3:
    """`[..., 3]` position in m and `[..., 3]` roll, pitch, yaw in rad to T_world_body."""
    return jaxlie.SE3.from_rotation_and_translation(rotation_from_rpy(rpy), position)


def exp(xi: jax.Array) -> jaxlie.SE3:
    """`[..., 6]` tangent (translation m, rotation rad) to a pose, exact to float32 rounding.

    `jaxlie.SE3.exp` replaces the left Jacobian by the rotation itself below 3e-3 rad, which
    is wrong to first order: straight driving at 10 Hz lives there. Here the translation is
    v + a (w x v) + b (w x (w x v)) with a = (1 - cos t)/t^2, b = (t - sin t)/t^3 and their
    series near zero, so values and derivatives are exact at any angle.
    """
    v, omega = xi[..., :3], xi[..., 3:]
    square = jnp.sum(omega * omega, axis=-1, keepdims=True)
    small = square < 1e-2
    # Both branches of a `where` are differentiated: keep the unused one finite.
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    a = jnp.where(small, 1 / 2 - square / 24 + square**2 / 720, (1 - jnp.cos(angle)) / safe)
    b = jnp.where(
        small, 1 / 6 - square / 120 + square**2 / 5040, (angle - jnp.sin(angle)) / (safe * angle)
    )
    once = jnp.cross(omega, v)
    translation = v + a * once + b * jnp.cross(omega, once)
    return jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.exp(omega), translation)


def log(pose: jaxlie.SE3) -> jax.Array:
    """A pose to its `[..., 6]` tangent (translation m, rotation rad)."""
    return pose.log()
