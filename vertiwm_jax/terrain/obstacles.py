"""Obstacles: axis-aligned boxes that stand on the ground."""

import jax
import jax.numpy as jnp

from vertiwm_jax.terrain.map import TerrainMap


def collides(
    terrain: TerrainMap, xy: jax.Array, yaw: jax.Array, length: float, width: float
) -> jax.Array:
    """Whether rectangles centred at `[..., 2]` with `[...]` yaw touch an obstacle: `[...]` bool.

    length: m along x of the body; width: m along y. Separating-axis test on the two axes of the
    map and the two of the body. A NaN pose touches nothing.
    """
    obstacles = terrain.obstacles[terrain.world]
    real = obstacles[:, 4] > 0
    offset = xy[..., None, :] - obstacles[:, :2]
    half = obstacles[:, 2:4] / 2
    cos, sin = jnp.cos(yaw)[..., None], jnp.sin(yaw)[..., None]
    x, y = offset[..., 0], offset[..., 1]
    wide, tall = half[:, 0], half[:, 1]
    c, s = jnp.abs(cos), jnp.abs(sin)
    touches = (
        (jnp.abs(x) <= wide + (c * length + s * width) / 2)
        & (jnp.abs(y) <= tall + (s * length + c * width) / 2)
        & (jnp.abs(cos * x + sin * y) <= length / 2 + c * wide + s * tall)
        & (jnp.abs(cos * y - sin * x) <= width / 2 + s * wide + c * tall)
    )
    return jnp.any(touches & real, axis=-1)
