"""SE(3) in float32: exponential, logarithm, roll-pitch-yaw and angle wrapping.

Rotations and poses are `jaxlie` groups. Tangent vectors are ordered translation first,
rotation second, as in the paper's Log (Eq. 3). Roll, pitch and yaw are
R = Rz(yaw) Ry(pitch) Rx(roll): positive pitch is nose down.

Functions that every step of a model calls are written by components (see `vector`): jaxlie's own
products gather components from arrays, and XLA makes a kernel of each.
"""

import jax
import jax.numpy as jnp
import jaxlie

from vertiwm_jax.vector import Axes, Vector

_LARGEST_SINE = 1 - 2**-24
"""The largest float32 below one, where the slope of the inverse sine is still finite."""
_SMALL = 1e-2
"""Square of an angle, rad^2, below which series of three terms are exact."""


def wrap(angle: jax.Array) -> jax.Array:
    """`[...]` angles in rad, mapped to [-pi, pi)."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def rotation_from_rpy(rpy: jax.Array) -> jaxlie.SO3:
    """`[..., 3]` roll, pitch, yaw in rad to the rotation from body to world."""
    cx, cy, cz = Vector.of(jnp.cos(0.5 * rpy))
    sx, sy, sz = Vector.of(jnp.sin(0.5 * rpy))
    w, x = cx * cy * cz + sx * sy * sz, sx * cy * cz - cx * sy * sz
    y, z = cx * sy * cz + sx * cy * sz, cx * cy * sz - sx * sy * cz
    return _rotation(w, Vector(x, y, z))


def rpy_from_rotation(rotation: jaxlie.SO3) -> jax.Array:
    """The rotation from body to world to `[..., 3]` roll, pitch, yaw in rad.

    Finite at every attitude; jaxlie's pitch is NaN where rounding lifts its sine above one.
    """
    w, x, y, z = jnp.moveaxis(rotation.wxyz, -1, 0)
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -_LARGEST_SINE, _LARGEST_SINE))
    roll, yaw = rotation.compute_roll_radians(), rotation.compute_yaw_radians()
    return jnp.stack([roll, pitch, yaw], axis=-1)


def compose(first: jaxlie.SO3, second: jaxlie.SO3) -> jaxlie.SO3:
    """The rotation first @ second, normalized."""
    (w, a), (u, b) = _parts(first), _parts(second)
    real, imaginary = w * u - a.dot(b), a.times(u).plus(b, w).plus(a.cross(b))
    scale = jax.lax.rsqrt(real**2 + imaginary.dot(imaginary))
    return _rotation(scale * real, imaginary.times(scale))


def rotate(rotation: jaxlie.SO3, v: jax.Array) -> jax.Array:
    """Vectors `[..., 3]` rotated by a rotation."""
    return Axes.from_quaternion(rotation.wxyz).to_world(Vector.of(v)).stacked()


def moved(position: jax.Array, rpy: jax.Array, xi: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Position `[..., 3]`, m, and roll, pitch, yaw, rad, of T Exp(xi), for those of T.

    xi: `[..., 6]` tangent in the frame of T.
    """
    rotation, step = rotation_from_rpy(rpy), exp(xi)
    turned = rpy_from_rotation(compose(rotation, step.rotation()))
    return position + rotate(rotation, step.translation()), turned


def exp(xi: jax.Array) -> jaxlie.SE3:
    """`[..., 6]` tangent (translation m, rotation rad) to a pose, exact to float32 rounding.

    `jaxlie.SE3.exp` replaces the left Jacobian by the rotation itself below 3e-3 rad, which
    is wrong to first order. Straight driving at 10 Hz has such angles. Here the translation is
    v + a (w x v) + b (w x (w x v)) with a = (1 - cos t)/t^2, b = (t - sin t)/t^3 and their
    series near zero, so values and derivatives are exact at any angle.
    """
    v, omega = Vector.of(xi[..., :3]), Vector.of(xi[..., 3:])
    square, cos, sinc = _half(omega)
    small = square < _SMALL
    a = 2 * sinc**2
    b = jnp.where(
        small,
        1 / 6 - square / 120 + square**2 / 5040,
        (1 - 2 * sinc * cos) / jnp.where(small, 1.0, square),
    )
    once = omega.cross(v)
    translation = v.plus(once, a).plus(omega.cross(once), b).stacked()
    rotation = _rotation(cos, omega.times(sinc))
    return jaxlie.SE3.from_rotation_and_translation(rotation, translation)


def rotation_from_vector(omega: jax.Array) -> jaxlie.SO3:
    """`[..., 3]` axis times angle in rad to a rotation."""
    axis = Vector.of(omega)
    _, cos, sinc = _half(axis)
    return _rotation(cos, axis.times(sinc))


def _rotation(real: jax.Array, imaginary: Vector) -> jaxlie.SO3:
    return jaxlie.SO3(jnp.stack([real, *imaginary], axis=-1))


def _parts(rotation: jaxlie.SO3) -> tuple[jax.Array, Vector]:
    """Of a rotation's quaternion: what `_rotation` puts together."""
    real, *imaginary = jnp.moveaxis(rotation.wxyz, -1, 0)
    return real, Vector(*imaginary)


def _half(omega: Vector) -> tuple[jax.Array, jax.Array, jax.Array]:
    """t^2 of an angle t, and of its half the cosine and the sine over t."""
    square = omega.dot(omega)
    small = square < _SMALL
    # Both branches of a `where` are differentiated: keep the unused one finite.
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    cos = jnp.where(small, 1 - square / 8 + square**2 / 384, jnp.cos(angle / 2))
    sinc = jnp.where(small, 1 / 2 - square / 48 + square**2 / 3840, jnp.sin(angle / 2) / angle)
    return square, cos, sinc


def log(pose: jaxlie.SE3) -> jax.Array:
    """A pose to its `[..., 6]` tangent (translation m, rotation rad): the inverse of `exp`.

    The translation is v - w x v / 2 + c (w x (w x v)) with c = (1 - (t/2) cot(t/2))/t^2.
    """
    (real, axis), translation = _parts(pose.rotation()), Vector.of(pose.translation())
    square = axis.dot(axis)
    small = square < _SMALL / 4  # sin^2 of half the angle
    sin = jnp.sqrt(jnp.where(small, 1.0, square))
    # Of both quaternions of a rotation, the one that turns by less than half a turn.
    sign, cos = jnp.where(real < 0, -1.0, 1.0), jnp.abs(real)
    half = jnp.where(small, 1.0, jnp.arctan2(sin, cos))
    safe = jnp.where(small, cos, 1.0)
    tan2 = square / safe**2
    series = (1 - tan2 / 3 + tan2**2 / 5) / safe
    omega = axis.times(2 * sign * jnp.where(small, series, half / sin))
    turn = omega.dot(omega)
    c = jnp.where(
        small,
        1 / 12 + turn / 720 + turn**2 / 30240,
        (1 - half * cos / sin) / jnp.where(small, 1.0, turn),
    )
    once = omega.cross(translation)
    v = translation.plus(once, -0.5).plus(omega.cross(once), c)
    return jnp.stack([*v, *omega], axis=-1)
