"""How springs, soil and hull share the load."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vertiwm_jax.mechanics.contact import GroundContact, tangents
from vertiwm_jax.mechanics.newton_euler import ContactForce, DampedForce, Twist, velocity_at
from vertiwm_jax.mechanics.vehicle import GRAVITY, Vehicle
from vertiwm_jax.mechanics.wheel import Motion, SoilContact, Wheel, WheelForces, rigid_forces
from vertiwm_jax.terrain.soil import Soil
from vertiwm_jax.vector import Vector

LEAST_SINKAGE = 1e-3
"""Sinkage, m, below which soil counts as linear."""
LARGEST_LOAD = 2.5
"""Largest normal force on one wheel, in vehicle weights."""
LEAST_UPRIGHT = 0.2
"""Cosine between body and ground normal below which wheels no longer carry."""
HULL_SECONDS = 0.1
"""Time in which the hull, lying on ground, would drop by its depth under the weight."""
HULL_FRICTION = 0.5
HULL_LOAD = 10.0
"""Largest force on the hull, in vehicle weights."""
HULL_DEPTH = 0.1
"""Depth, m, beyond which the hull is pushed out no faster: what is deep in comes out slowly."""
CLIMB_SPEED = 2.0
"""Speed, m/s, at which a wheel that finds itself in the ground is lifted out of it."""
ADHESION_SPEED = 0.1
"""Slip speed, m/s, at which friction has reached 70 % of its limit, where a vehicle does not say
it."""


class WheelSupport(NamedTuple):
    """How the suspension presses each wheel `[4]` onto the ground.

    droop: m, the height in the body to which a free wheel would fall within the sub-step.
    depth: m below the tangent plane at that height. upright: cosine between body and normal.
    stiffness: N/m along the normal. carrying: bool.
    """

    droop: jax.Array
    depth: jax.Array
    upright: jax.Array
    stiffness: jax.Array
    carrying: jax.Array


def suspend(
    vehicle: Vehicle,
    wheels: GroundContact,
    travel: jax.Array,
    sinkage: jax.Array,
    leaving: jax.Array,
    seconds: float,
) -> WheelSupport:
    """Implicit Euler of a massless wheel between spring, damper, its weight and the ground.

    leaving: `[4]` m/s, velocity along the normal.
    """
    upright = jnp.maximum(wheels.normal.z, LEAST_UPRIGHT)
    damping = vehicle.damper / seconds
    stiffness = vehicle.spring + damping
    relaxed = vehicle.spring * vehicle.free_travel + damping * travel - vehicle.wheel_weight
    droop = relaxed / stiffness
    stepped_in = jnp.minimum(wheels.depth, sinkage + CLIMB_SPEED * seconds)
    depth = stepped_in + upright * (travel - droop) - seconds * leaving
    carrying = (wheels.normal.z > LEAST_UPRIGHT) & (depth > 0)
    # Beyond the largest load a contact yields: no wheel is thrown out of ground it stepped into.
    largest = LARGEST_LOAD * vehicle.mass * GRAVITY
    pressed = jnp.maximum(depth - sinkage, LEAST_SINKAGE)
    stiffness = jnp.minimum(stiffness / upright**2, largest / pressed)
    return WheelSupport(droop, depth, upright, jnp.where(carrying, stiffness, 0.0), carrying)


def support(
    vehicle: Vehicle,
    contact: SoilContact,
    soil: Soil,
    wheels: GroundContact,
    press: WheelSupport,
    sinkage: jax.Array,
    motion: Motion,
    rut: jax.Array,
) -> tuple[WheelForces, jax.Array, jax.Array, jax.Array]:
    """Forces on the wheels, new sinkage m, load N and its stiffness N/m, all `[4]`.

    sinkage: m, so far.

    Soil and suspension share the depth: one Newton step a sub-step toward the sinkage at which
    their forces agree. Rigid ground leaves all of it to the suspension.
    """
    wheel = Wheel(vehicle.wheel_radius, vehicle.wheel_width)
    in_soil = contact.forces(wheel, soil, sinkage, motion, rut)
    # Normal force grows about like sinkage to the power n + 1/2 (Bekker, wheel on flat ground).
    sunk = jnp.maximum(sinkage - rut, LEAST_SINKAGE)
    yielding = (soil.n + 0.5) * in_soil.normal / sunk
    together = press.stiffness + yielding
    together = jnp.where(together > 0, together, 1.0)
    wanted = press.stiffness * press.depth - in_soil.normal + yielding * sinkage
    sinkage = jnp.where(wheels.soft, jnp.maximum(wanted / together, 0.0), 0.0)
    load = press.stiffness * jnp.maximum(press.depth - sinkage, 0.0)
    rate = press.stiffness * jnp.where(wheels.soft, yielding / together, 1.0)

    friction = jnp.minimum(wheels.friction, vehicle.tyre_friction)
    on_rock = rigid_forces(wheel, friction, load, motion, adhesion_speed(vehicle))
    # Soil shears under the load that is really on it, whatever the sinkage says for now.
    loaded = jnp.minimum(load / jnp.maximum(in_soil.normal, 1.0), 1.0)
    ground = jax.tree.map(lambda a, b: jnp.where(wheels.soft, loaded * a, b), in_soil, on_rock)
    return ground, sinkage, load, rate


def adhesion_speed(vehicle: Vehicle) -> jax.Array | float:
    """Slip speed of a tire, m/s, at which friction has reached 70 % of its limit."""
    return ADHESION_SPEED if vehicle.skid is None else vehicle.skid.slip_speed


def hull_contact(
    vehicle: Vehicle, twist: Twist, hull: GroundContact, center: Vector, seconds: float
) -> ContactForce:
    """The chassis on the ground: a heavily damped spring, and friction.

    Soil gives way under the belly, as Chrono's SCM feels wheels only, but not under a roof.
    """
    arm, n = hull.point.plus(center, -1.0), hull.normal
    forward, left = tangents(n, jnp.ones(1), jnp.zeros(1))
    velocity = velocity_at(twist, arm)
    stiffness = 2 * vehicle.mass / HULL_SECONDS**2
    rate = stiffness * (seconds + HULL_SECONDS)
    gives_way = hull.soft & (n.z > LEAST_UPRIGHT)
    load = stiffness * jnp.minimum(hull.depth, HULL_DEPTH) - rate * velocity.dot(n)
    load = jnp.minimum(load, HULL_LOAD * vehicle.mass * GRAVITY)
    pressing = (hull.depth > 0) & ~gives_way & (load > 0)
    load, rate = jnp.where(pressing, load, 0.0), jnp.where(pressing, rate, 0.0)
    ahead, drift = velocity.dot(forward), velocity.dot(left)
    grip = HULL_FRICTION * load * jax.lax.rsqrt(ahead**2 + drift**2 + ADHESION_SPEED**2)
    return ContactForce.of(
        arm,
        DampedForce(n, load, rate),
        DampedForce(forward, -grip * ahead, grip),
        DampedForce(left, -grip * drift, grip),
    )
