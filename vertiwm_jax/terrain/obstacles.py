"""Obstacles: axis-aligned boxes that stand on the ground; those whose middle is known."""

import jax
import jax.numpy as jnp

from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap


def collides(
    terrain: TerrainMap, xy: jax.Array, yaw: jax.Array, length: float, width: float
) -> jax.Array:
    """Whether rectangles centred at `[..., 2]` with `[...]` yaw touch an obstacle: `[...]` bool.

    length: m along x of the body; width: m along y. A NaN pose touches nothing.
    """
    return jnp.any(_gaps(terrain, xy, yaw, length, width) <= 0, axis=-1)


def gap(
    terrain: TerrainMap, xy: jax.Array, yaw: jax.Array, length: float, width: float
) -> jax.Array:
    """`[...]` m between the rectangles of `collides` and the nearest obstacle; inf without any.

    Seen along the axes of the map or of the body, whichever shows more, so never more than the
    distance, and less past corners. Where they touch it is not positive, and says how far in.
    """
    return jnp.min(_gaps(terrain, xy, yaw, length, width), axis=-1, initial=jnp.inf)


def _gaps(
    terrain: TerrainMap, xy: jax.Array, yaw: jax.Array, length: float, width: float
) -> jax.Array:
    """`[..., N]` m to each obstacle, inf to rows not in use and to obstacles that are not known.

    Separating-axis test on the two axes of the map and the two of the body.
    """
    obstacles = terrain.obstacles[terrain.world]
    offset = xy[..., None, :] - obstacles[:, :2]
    half = obstacles[:, 2:4] / 2
    cos, sin = jnp.cos(yaw)[..., None], jnp.sin(yaw)[..., None]
    x, y = offset[..., 0], offset[..., 1]
    wide, tall = half[:, 0], half[:, 1]
    c, s = jnp.abs(cos), jnp.abs(sin)
    on_map = jnp.maximum(
        jnp.abs(x) - (wide + (c * length + s * width) / 2),
        jnp.abs(y) - (tall + (s * length + c * width) / 2),
    )
    on_body = jnp.maximum(
        jnp.abs(cos * x + sin * y) - (length / 2 + c * wide + s * tall),
        jnp.abs(cos * y - sin * x) - (width / 2 + s * wide + c * tall),
    )
    there = obstacles[:, 4] > 0
    if terrain.belief is not None:
        there &= query.known(terrain, obstacles[:, :2])
    return jnp.where(there, jnp.maximum(on_map, on_body), jnp.inf)
