"""A wheel, the forces on it, and Coulomb friction on rigid ground.

Written for arrays of wheels: parameters and states broadcast against each other elementwise, any
leading axes `[...]`. Soil is in `bekker_wong` and `scm`, whose parameters give the forces of it.
"""

from typing import Protocol

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.terrain.soil import Soil

Scalar = jax.Array | float

MIN_SINKAGE = 1e-6
"""Sinkage in wheel radii below which a wheel is in the air."""
MAX_SINKAGE = 1.5
"""Sinkage in wheel radii beyond which forces no longer grow: the equations end there."""


@struct.dataclass
class Wheel:
    """A rigid wheel `[...]`. radius, width: m."""

    radius: Scalar
    width: Scalar


@struct.dataclass
class WheelForces:
    """Forces of the ground on a wheel `[...]`, in the wheel's frame: x ahead, y left, z up.

    longitudinal: N; on soil the drawbar pull, compaction resistance included.
    lateral: N; opposes the lateral velocity.
    normal: N.
    torque: N m of the ground about the axle; positive brakes positive spin.
    """

    longitudinal: jax.Array
    lateral: jax.Array
    normal: jax.Array
    torque: jax.Array


class SoilContact(Protocol):
    """Parameters of a contact with soil, whose method gives its forces on a wheel."""

    def forces(
        self,
        wheel: Wheel,
        soil: Soil,
        sinkage: Scalar,
        velocity_x: Scalar,
        velocity_y: Scalar,
        omega: Scalar,
        rut: Scalar = 0.0,
        nodes: int = 6,
    ) -> WheelForces:
        """Forces on a wheel at a given sinkage, all `[...]`.

        Args:
            wheel, soil: of any axes `[...]`.
            sinkage: m below the undisturbed surface. At or above the floor of the rut there is no
                force.
            velocity_x, velocity_y: m/s of the hub, ahead and to the left.
            omega: rad/s of the wheel, positive ahead.
            rut: m, the deepest sinkage that earlier passes left.
            nodes: of Gauss-Legendre's rule in each piece of the contact.
        """
        ...


def rigid_forces(
    wheel: Wheel,
    friction: Scalar,
    load: Scalar,
    velocity_x: Scalar,
    velocity_y: Scalar,
    omega: Scalar,
    creep_speed: Scalar = 0.05,
) -> WheelForces:
    """Coulomb friction under a wheel on rigid ground, all `[...]`; |force| < friction load.

    load: N, taken as zero when negative. creep_speed: m/s of slip at which friction reaches 71 %
    of its bound, which makes it smooth at rest.
    """
    load = jnp.maximum(load, 0.0)
    slip_x = wheel.radius * omega - velocity_x
    slip_y = -jnp.asarray(velocity_y)
    scale = friction * load * jax.lax.rsqrt(slip_x**2 + slip_y**2 + creep_speed**2)
    longitudinal = scale * slip_x
    return WheelForces(longitudinal, scale * slip_y, load, wheel.radius * longitudinal)


def contact_angle(depth: jax.Array) -> jax.Array:
    """acos(1 - depth) without its cancellation; zero, with zero slope, at depth <= 0."""
    positive = depth > 0
    half = jnp.sqrt(jnp.where(positive, depth, 1.0) / 2)
    return jnp.where(positive, 2 * jnp.arcsin(half), 0.0)


def sin_cos(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sine and cosine for |x| < 2.1, to float32: the library's would take most of the time."""
    y = x * x
    sin = x * _horner(y, 1, -1 / 6, 1 / 120, -1 / 5040, 1 / 362880, -1 / 39916800)
    cos = _horner(y, 1, -1 / 2, 1 / 24, -1 / 720, 1 / 40320, -1 / 3628800, 1 / 479001600)
    return sin, cos


def _horner(x: jax.Array, *coefficients: float) -> jax.Array:
    value = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = coefficient + x * value
    return value
