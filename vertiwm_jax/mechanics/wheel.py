"""A wheel, the forces on it, and Coulomb friction on rigid ground.

Written for arrays of wheels: parameters and states broadcast against each other elementwise, any
leading axes `[...]`. Soil is in `bekker_wong` and `scm`, whose parameters give the forces of it.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.terrain.soil import Soil

T = TypeVar("T")
Float = jax.Array | float
Arrays = tuple[jax.Array, ...]
Motion = tuple[Float, Float, Float]
"""Of a wheel: velocity of the hub ahead and to the left, m/s, and spin, rad/s, positive ahead."""

MIN_SINKAGE = 1e-6
"""Sinkage in wheel radii below which a wheel is in the air."""
MAX_SINKAGE = 1.5
"""Sinkage in wheel radii beyond which forces no longer grow: the equations end there."""


@struct.dataclass
class Wheel:
    """A rigid wheel `[...]`. radius, width: m."""

    radius: Float
    width: Float


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
        self, wheel: Wheel, soil: Soil, sinkage: Float, motion: Motion, rut: Float = 0.0
    ) -> WheelForces:
        """Forces on a wheel at a given sinkage, all `[...]`.

        Args:
            wheel, soil: of any axes `[...]`.
            sinkage: m below the undisturbed surface. At or above the floor of the rut there is no
                force.
            motion: of the wheel.
            rut: m, the deepest sinkage that earlier passes left.
        """
        ...


def broadcast(arguments: T) -> tuple[Any, T]:
    """The shape that all leaves broadcast to, and these in float32."""
    arrays = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), arguments)
    return jnp.broadcast_shapes(*(x.shape for x in jax.tree.leaves(arrays))), arrays


def depth_below(floor: Float, sinkage: Float, wheel: Wheel) -> tuple[jax.Array, jax.Array]:
    """How deep a wheel is in the soil below `floor`, m, in radii, and whether it touches it."""
    depth = jnp.clip((sinkage - floor) / wheel.radius, 0.0, MAX_SINKAGE)
    touching = depth > MIN_SINKAGE
    return jnp.where(touching, depth, MIN_SINKAGE), touching


def integrated(
    stresses: Callable[..., tuple[jax.Array, Arrays]], nodes: Arrays, shape: tuple[int, ...]
) -> Arrays:
    """Four integrals `[...]` over a contact, of the weight and stresses at each node.

    A loop over nodes, each a pass over all wheels, is many times faster than an axis of nodes:
    nothing of a node goes through memory, nor, with the checkpoint, in the backward pass.
    """

    @partial(jax.checkpoint, prevent_cse=False)
    def add(total: Arrays, node: Arrays) -> tuple[Arrays, None]:
        weight, found = stresses(*node)
        return tuple(t + weight * x for t, x in zip(total, found, strict=True)), None

    return jax.lax.scan(add, (jnp.zeros(shape),) * 4, nodes)[0]


def rigid_forces(
    wheel: Wheel, friction: Float, load: Float, motion: Motion, creep_speed: Float = 0.05
) -> WheelForces:
    """Coulomb friction under a wheel on rigid ground, all `[...]`; |force| < friction load.

    load: N, taken as zero when negative. creep_speed: m/s of slip at which friction reaches 71 %
    of its bound, which makes it smooth at rest.
    """
    velocity_x, velocity_y, omega = motion
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
