"""Forces on a rigid wheel: Bekker-Wong on soil, Coulomb friction on rigid ground.

Written for arrays of wheels: parameters and states broadcast against each other elementwise,
any leading axes `[...]`. See `stress` for the equations and their sources.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.mechanics import stress
from vertiwm_jax.mechanics.stress import Contact, Scalar, Wheel, slip
from vertiwm_jax.terrain.soil import Soil

__all__ = [
    "COMPACT_SAND",
    "LOOSE_SAND",
    "MAX_SINKAGE",
    "Contact",
    "Wheel",
    "WheelForces",
    "forces",
    "rigid_forces",
    "slip",
]

COMPACT_SAND = Contact(peak=0.43, peak_slip=0.32)
"""Wong and Reece (1967)."""
LOOSE_SAND = Contact(peak=0.18, peak_slip=0.32)
"""Wong and Reece (1967)."""

MAX_SINKAGE = 1.5
"""Sinkage in wheel radii beyond which forces no longer grow: the equations end there."""

Arrays = tuple[jax.Array, ...]

_MIN_SINKAGE = 1e-6  # in wheel radii; below it the wheel is airborne


@struct.dataclass
class WheelForces:
    """What the ground does to a wheel `[...]`, in the wheel's frame: x ahead, y left, z up.

    longitudinal: N; on soil the drawbar pull, compaction resistance included.
    lateral: N; opposes the lateral velocity.
    normal: N.
    torque: N m about the axle that the ground resists with: positive brakes positive spin.
    """

    longitudinal: jax.Array
    lateral: jax.Array
    normal: jax.Array
    torque: jax.Array


def forces(
    wheel: Wheel,
    soil: Soil,
    contact: Contact,
    sinkage: Scalar,
    velocity_x: Scalar,
    velocity_y: Scalar,
    omega: Scalar,
    rut: Scalar = 0.0,
    nodes: int = 6,
) -> WheelForces:
    """Forces on a wheel at a given sinkage, all `[...]`, continuous through every regime.

    sinkage: m below the undisturbed surface; at or above the floor of the rut there is no force.
    velocity_x, velocity_y: m/s of the hub, ahead and to the left. omega: rad/s, positive ahead.
    rut: m, the deepest sinkage that earlier passes left.
    nodes: Gauss-Legendre nodes in each of five pieces of the contact; 6 are within 0.1 % (99 % of
        random wheels, soils and motions).

    Driven, braked, towed, reversing and standing wheels are one formula; values and gradients
    are finite for any finite state. Only a wheel that spins against its travel as fast as it
    travels jumps, when the direction in which it enters the soil changes.
    """
    arguments = (wheel, soil, contact, sinkage, velocity_x, velocity_y, omega, rut)
    arguments = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), arguments)
    shape = jnp.broadcast_shapes(*(x.shape for x in jax.tree.leaves(arguments)))
    wheel, soil, contact, sinkage, velocity_x, velocity_y, omega, rut = arguments

    m = stress.motion(wheel, contact.creep_speed, velocity_x, velocity_y, omega)
    n = soil.n + contact.slip_sinkage * jnp.maximum(m.slip, 0.0)
    n = n + contact.skid_sinkage * jnp.maximum(-m.slip, 0.0)
    keq = soil.kc / wheel.width + soil.kphi
    floor, unload = stress.reloading(contact, keq, n, rut)

    depth = jnp.clip((sinkage - floor) / wheel.radius, 0.0, MAX_SINKAGE)
    touching = depth > _MIN_SINKAGE
    depth = jnp.where(touching, depth, _MIN_SINKAGE)
    patch = stress.patch(contact, soil.friction_angle, depth, m)
    starts = jnp.stack(stress.breaks(patch, m))
    extents = jnp.diff(starts, axis=0)

    @partial(jax.checkpoint, prevent_cse=False)
    def add_node(total: Arrays, node: Arrays) -> tuple[Arrays, None]:
        panel, point, weight = node
        extent = extents[panel]
        at = stress.arc(patch, starts[panel] + point * extent)
        z = wheel.radius * stress.pressing_depth(patch, at.angle)
        sigma = stress.normal_stress(keq, n, unload, floor, z)
        tau_x, tau_y = stress.shear_stress(soil, contact, patch, m, at, sigma)
        side = stress.bulldozing(soil, contact, wheel.radius, patch, m, at)
        integrands = (
            tau_x * at.cos - m.rolling * sigma * at.sin,
            wheel.width * tau_y + side,
            sigma * at.cos + m.rolling * tau_x * at.sin,
            tau_x,
        )
        weight = weight * extent
        return tuple(t + weight * y for t, y in zip(total, integrands, strict=True)), None

    # A loop over nodes, each a pass over all wheels, is many times faster than an axis of nodes:
    # nothing of a node goes through memory, nor, with the checkpoint, in the backward pass.
    total, _ = jax.lax.scan(add_node, (jnp.zeros(shape),) * 4, _quadrature(nodes))
    longitudinal, lateral, normal, torque = (jnp.where(touching, t, 0.0) for t in total)
    area = wheel.radius * wheel.width
    return WheelForces(
        longitudinal=m.ahead * area * longitudinal,
        lateral=wheel.radius * lateral,
        normal=area * normal,
        torque=m.ahead * area * wheel.radius * torque,
    )


def _quadrature(nodes: int) -> Arrays:
    """Panel, Gauss-Legendre point and weight on [0, 1] of every node, `[panels * nodes]`.

    Crowded by a square towards the exit in the first panel and the entry in the last, where
    stress grows like a power and shear like an exponential of the distance, by a cubic towards
    both ends of those between, where shear reverses.
    """
    x, w = np.polynomial.legendre.leggauss(nodes)
    x, w = (x + 1) / 2, w / 2
    middle = (x**2 * (3 - 2 * x), 6 * x * (1 - x) * w)
    panels = [(x**2, 2 * x * w), *[middle] * (stress.PANELS - 2), (1 - x**2, 2 * x * w)]
    points, weights = np.concatenate(panels, axis=1, dtype=np.float32)
    panel = jnp.repeat(jnp.arange(stress.PANELS), nodes)
    return panel, jnp.asarray(points), jnp.asarray(weights)


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
