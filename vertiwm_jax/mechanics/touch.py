"""Where a vehicle touches the ground: its treads and its hull against the map."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vertiwm_jax.mechanics.vector import Axes, Vector
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import Soil

TREAD_ANGLES = (-0.7, -0.35, 0.0, 0.35, 0.7)
"""Where both rims of a wheel are tested against the ground, rad from straight down."""
SHARED_DEPTH = 0.005
"""Depth, m, over which neighbouring points of a tread share a contact."""


class Touch(NamedTuple):
    """Contacts `[C]` of one kind; vectors in body components.

    point: m from the body origin, where the contact acts.
    normal: of the ground, unit length.
    depth: m below the ground's tangent plane; negative above it.
    friction: coefficient of rigid ground, 0 on soil.
    soft: bool, whether the ground is soil; soil: that soil.
    """

    point: Vector
    normal: Vector
    depth: jax.Array
    friction: jax.Array
    soft: jax.Array
    soil: Soil


def touch(
    vehicle: Vehicle,
    terrain: TerrainMap,
    position: Vector,
    axes: Axes,
    travel: jax.Array,
    steering: jax.Array,
) -> tuple[Touch, Touch]:
    """Contacts of the four wheels `[4]` and of the deepest hull point `[1]`, in one query.

    A wheel is a cylinder. Testing points on both rims, rather than the ground under the hub,
    lets it roll over edges and stand on a rim; neighbouring points of like depth share the
    contact, so that it moves smoothly.

    travel: `[4]` m, height of the wheel centres in the body; steering: `[4]` rad.
    """
    tread, hull = _tread(vehicle, travel, steering), Vector.of(vehicle.hull)
    shape, count = tread.x.shape, tread.x.size
    points = Vector(*(jnp.concatenate([a.ravel(), b]) for a, b in zip(tread, hull, strict=True)))
    world = position.plus(axes.to_world(points))
    ground = query.surface(terrain, jnp.stack([world.x, world.y], axis=-1))
    slope_x, slope_y = ground.gradient[:, 0], ground.gradient[:, 1]
    up = jax.lax.rsqrt(1 + slope_x**2 + slope_y**2)
    normal = axes.to_body(Vector(-slope_x * up, -slope_y * up, up))
    depth = (ground.height - world.z) * up

    def on_tread(values: jax.Array) -> jax.Array:
        return values[:count].reshape(shape)

    share = jax.nn.softmax(on_tread(depth) / SHARED_DEPTH, axis=0)

    def shared(values: jax.Array) -> jax.Array:
        return jnp.sum(share * values, axis=0)

    below = on_tread(ground.semantic)[shape[0] // 2]
    wheels = Touch(
        point=Vector(*map(shared, tread)),
        normal=Vector(*(shared(on_tread(c)) for c in normal)).normalised(),
        depth=shared(on_tread(depth)),
        friction=shared(on_tread(ground.friction)),
        soft=terrain.deformable[below],
        soil=jax.tree.map(lambda leaf: leaf[below], terrain.soils),
    )

    deepest = count + jnp.argmax(depth[count:])[None]
    under = ground.semantic[deepest]
    chassis = Touch(
        point=Vector(*(c[deepest] for c in points)),
        normal=Vector(*(c[deepest] for c in normal)),
        depth=depth[deepest],
        friction=ground.friction[deepest],
        soft=terrain.deformable[under],
        soil=jax.tree.map(lambda leaf: leaf[under], terrain.soils),
    )
    return wheels, chassis


def _tread(vehicle: Vehicle, travel: jax.Array, steering: jax.Array) -> Vector:
    """Points `[2 angles, 4]` on both rims of the lower half of each wheel, from the origin."""
    angle = jnp.repeat(jnp.array(TREAD_ANGLES), 2)[:, None]
    side = jnp.tile(jnp.array([0.5, -0.5]), len(TREAD_ANGLES))[:, None]
    ahead, left = vehicle.wheel_radius * jnp.sin(angle), vehicle.wheel_width * side
    cos, sin = jnp.cos(steering), jnp.sin(steering)
    return Vector(
        vehicle.wheel_position[:, 0] + ahead * cos - left * sin,
        vehicle.wheel_position[:, 1] + ahead * sin + left * cos,
        travel - vehicle.wheel_radius * jnp.cos(angle) + 0 * left,
    )
