"""Obstacles: axis-aligned boxes on the ground, as far as their middle is known."""

import jax
import jax.numpy as jnp

from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap

Side = float | jax.Array


def collides(
    terrain: TerrainMap, xy: jax.Array, yaw: jax.Array, length: Side, width: Side
) -> jax.Array:
    """Whether rectangles centered at `[..., 2]` with `[...]` yaw touch an obstacle: `[...]` bool.

    length: m along x of the body; width: m along y. A NaN pose touches nothing.
    """
    return gap(terrain, xy, yaw, length, width) <= 0


def gap(terrain: TerrainMap, xy: jax.Array, yaw: jax.Array, length: Side, width: Side) -> jax.Array:
    """`[...]` m between the rectangles of `collides` and the nearest obstacle; inf without any.

    This is the largest gap on the two axes of the map and the two of the body (separating-axis
    test): never more than the distance, and less past corners. Where they touch it is not
    positive, and says how deep. Unknown obstacles do not count.
    """
    obstacles = terrain.obstacles[terrain.world]
    there = obstacles[:, 4] > 0
    if terrain.observed is not None:
        there &= query.known(terrain, obstacles[:, :2])
    x, y = xy[..., 0], xy[..., 1]
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    c, s = jnp.abs(cos), jnp.abs(sin)
    reach = (c * length + s * width) / 2, (s * length + c * width) / 2

    def nearer(nearest: jax.Array, one: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        (east, north, wide, tall, _), stands = one
        dx, dy, wide, tall = x - east, y - north, wide / 2, tall / 2
        on_map = jnp.maximum(jnp.abs(dx) - (wide + reach[0]), jnp.abs(dy) - (tall + reach[1]))
        on_body = jnp.maximum(
            jnp.abs(cos * dx + sin * dy) - (length / 2 + c * wide + s * tall),
            jnp.abs(cos * dy - sin * dx) - (width / 2 + s * wide + c * tall),
        )
        apart = jnp.where(stands, jnp.maximum(on_map, on_body), jnp.inf)
        return jnp.minimum(nearest, apart), None

    # One obstacle after the other, for all rectangles at once.
    none = jnp.full(jnp.broadcast_shapes(x.shape, cos.shape), jnp.inf)
    return jax.lax.scan(nearer, none, (obstacles, there))[0]
