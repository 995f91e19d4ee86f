"""Where wheels and hull touch the ground."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import Soil
from vertiwm_jax.vector import Axes, Vector

TREAD_ANGLES = (-0.7, -0.35, 0.0, 0.35, 0.7)
"""Where both rims of a wheel are tested against the ground, rad from straight down."""
SHARED_DEPTH = 0.005
"""Depth, m, over which neighboring points of a tread share a contact."""
LEAST_YIELD = 0.01
"""Depth, m, by which soil gives way at least before it carries beside rigid ground."""

_RIM_ANGLES = np.repeat(np.asarray(TREAD_ANGLES, np.float32), 2)[:, None]


class GroundContact(NamedTuple):
    """Contacts `[C]` of one kind; vectors in body components.

    point: m from the body origin, where the contact acts.
    normal: of the ground, unit length.
    depth: m below the ground's tangent plane; negative above it.
    friction: coefficient of rigid ground, 0 on soil.
    soft: bool, whether the ground is soil; soil: that soil.
    edge: bool, whether it is an edge of rigid ground on which a wheel in soil leans.
    """

    point: Vector
    normal: Vector
    depth: jax.Array
    friction: jax.Array
    soft: jax.Array
    soil: Soil
    edge: jax.Array


class _Samples(NamedTuple):
    """Points of the vehicle `[...]` against the ground below them, as in `GroundContact`."""

    point: Vector
    normal: Vector
    depth: jax.Array
    friction: jax.Array
    semantic: jax.Array


def contacts(
    vehicle: Vehicle,
    terrain: TerrainMap,
    position: Vector,
    axes: Axes,
    travel: jax.Array,
    steering: jax.Array,
    sinkage: jax.Array,
) -> tuple[GroundContact, GroundContact]:
    """Contacts of the four wheels `[4]` and of the deepest hull point `[1]`, in one query.

    travel: `[4]` m, height of the wheel centers in the body; steering: `[4]` rad; sinkage: `[4]`
    m, how deep the wheels are in soil already.
    """
    tread, hull = _tread(vehicle, travel, steering), Vector.of(vehicle.hull)
    shape, count = tread.x.shape, tread.x.size
    points = Vector(*(jnp.concatenate([a.ravel(), b]) for a, b in zip(tread, hull, strict=True)))
    world = position.plus(axes.to_world(points))
    ground = query.surface(terrain, jnp.stack([world.x, world.y], axis=-1))
    slope_x, slope_y = ground.gradient[:, 0], ground.gradient[:, 1]
    up = jax.lax.rsqrt(1 + slope_x**2 + slope_y**2)
    samples = _Samples(
        point=points,
        normal=axes.to_body(Vector(-slope_x * up, -slope_y * up, up)),
        depth=(ground.height - world.z) * up,
        friction=ground.friction,
        semantic=ground.semantic,
    )
    on_tread = jax.tree.map(lambda x: x[:count].reshape(shape), samples)
    deepest = count + jnp.argmax(samples.depth[count:])[None]
    on_hull = jax.tree.map(lambda x: x[deepest], samples)
    chassis = GroundContact(
        *on_hull[:-1],
        soft=terrain.deformable[on_hull.semantic],
        soil=query.soil(terrain, on_hull.semantic),
        edge=jnp.zeros(1, bool),
    )
    return _wheel_contacts(terrain, on_tread, steering, sinkage), chassis


def tangents(normal: Vector, cos: jax.Array, sin: jax.Array) -> tuple[Vector, Vector]:
    """Directions in the tangent plane along and to the left of a heading in the body."""
    rise = normal.x * cos + normal.y * sin
    along = Vector(cos - rise * normal.x, sin - rise * normal.y, -rise * normal.z).normalized()
    return along, normal.cross(along)


def _wheel_contacts(
    terrain: TerrainMap, tread: _Samples, steering: jax.Array, sinkage: jax.Array
) -> GroundContact:
    """One contact `[4]` of each wheel, shared by the points `[2 angles, 4]` that carry it.

    A wheel is a cylinder. Testing points on both rims, rather than the ground under the hub,
    lets it roll over edges and stand on a rim; neighboring points of like depth share the
    contact, so that it moves smoothly. It rests on either rigid ground or soil: soil carries only
    what has sunk into it, so rigid ground beside it is a step, whose edge pushes toward the axle.
    """
    soft = terrain.deformable[tread.semantic]
    carried = tread.depth - jnp.where(soft, jnp.maximum(sinkage, LEAST_YIELD), 0.0)
    share = jax.nn.softmax(carried / SHARED_DEPTH, axis=0)
    in_soil = jnp.sum(share * soft, axis=0) > 0.5
    share = share * (soft == in_soil)
    share = share / jnp.sum(share, axis=0)

    def shared(values: jax.Array | np.ndarray) -> jax.Array:
        return jnp.sum(share * values, axis=0)

    lowest = len(TREAD_ANGLES) - 1, len(TREAD_ANGLES)
    edge = ~in_soil & soft[lowest[0]] & soft[lowest[1]]
    # Along its own normal, the wheel is as much less deep in it as that is tilted.
    ahead, up = shared(np.sin(_RIM_ANGLES)), shared(np.cos(_RIM_ANGLES))
    to_axle = Vector(-ahead * jnp.cos(steering), -ahead * jnp.sin(steering), up).normalized()
    upright = Vector(*map(shared, tread.normal)).normalized()
    # Of two soils that carry alike, that under the left rim.
    below = jnp.take_along_axis(tread.semantic, jnp.argmax(share, axis=0)[None], axis=0)[0]
    return GroundContact(
        point=Vector(*map(shared, tread.point)),
        normal=Vector(*(jnp.where(edge, a, b) for a, b in zip(to_axle, upright, strict=True))),
        depth=shared(tread.depth) * jnp.where(edge, to_axle.z, 1.0),
        friction=shared(tread.friction),
        soft=in_soil,
        soil=query.soil(terrain, below),
        edge=edge,
    )


def _tread(vehicle: Vehicle, travel: jax.Array, steering: jax.Array) -> Vector:
    """Points `[2 angles, 4]` on both rims of the lower half of each wheel, from the origin."""
    side = np.tile(np.asarray([0.5, -0.5], np.float32), len(TREAD_ANGLES))[:, None]
    ahead, left = vehicle.wheel_radius * jnp.sin(_RIM_ANGLES), vehicle.wheel_width * side
    cos, sin = jnp.cos(steering), jnp.sin(steering)
    return Vector(
        vehicle.wheel_position[:, 0] + ahead * cos - left * sin,
        vehicle.wheel_position[:, 1] + ahead * sin + left * cos,
        travel - vehicle.wheel_radius * jnp.cos(_RIM_ANGLES) + 0 * left,
    )
