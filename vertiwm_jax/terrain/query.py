"""The ground under points of a map; `_raster` says what lies off the map."""

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.terrain import _raster
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import Soil


@struct.dataclass
class Surface:
    """The ground at points.

    height: `[...]` m.
    gradient: `[..., 2]` dz/dx and dz/dy in the world frame; 0 across the edge of the map.
    semantic: `[...]` int32 class id.
    friction: `[...]` friction coefficient; 0 on soil.
    """

    height: jax.Array
    gradient: jax.Array
    semantic: jax.Array
    friction: jax.Array


def surface(terrain: TerrainMap, xy: jax.Array) -> Surface:
    """The ground as wheels meet it at points `[..., 2]` p_world, m.

    Between vertices, soil is bilinear and rigid ground is two triangles split from bottom left
    to top right, as Chrono builds them. Differentiable: the gradient of `height` with respect
    to `xy` is `gradient`.
    """
    column, row = _on_map(terrain, xy)
    cell = _raster.cell_index(terrain, row, column)
    semantic = _raster.classes(terrain, row, column, cell)
    soft = _raster.gather(terrain.deformable, semantic)
    bottom_left, along, up, twist, fx, fy = _raster.corners(terrain, row, column)
    rising = fx > fy
    height = (
        bottom_left
        + fx * along
        + fy * up
        # With the minimum instead of the product, the same formula is the two triangles.
        + twist * jnp.where(soft, fx * fy, jnp.where(rising, fy, fx))
    )
    slope_x = along + twist * jnp.where(soft, fy, jnp.where(rising, 0.0, 1.0))
    slope_y = up + twist * jnp.where(soft, fx, jnp.where(rising, 1.0, 0.0))
    gradient = jnp.stack([slope_x, slope_y], axis=-1) / terrain.resolution
    from_corner = (xy - terrain.origin) * jnp.array([1.0, -1.0])
    inside = (from_corner >= 0) & (from_corner <= terrain.size)
    gradient = jnp.where(inside, gradient, 0.0)
    friction = _raster.gather(terrain.friction, cell)
    if terrain.grip is not None:
        friction = terrain.grip * friction
    friction = _raster.as_observed(terrain, row, column, friction, lambda seen: seen.friction)
    return Surface(height, gradient, semantic, friction)


def soil(terrain: TerrainMap, semantic: jax.Array) -> Soil:
    """The soils `[...]` of ground classes `[...]` in the selected world; rigid ones have any."""
    return jax.tree.map(lambda leaf: leaf[semantic], soils(terrain))


def soils(terrain: TerrainMap) -> Soil:
    """The soils `[K]` of all ground classes in the selected world."""
    own = len(terrain.soils.n) > 1
    return jax.tree.map(lambda leaf: leaf[terrain.world if own else 0], terrain.soils)


def height(terrain: TerrainMap, xy: jax.Array) -> jax.Array:
    """`[..., 2]` p_world to `[...]` bilinear height, m, whatever the class."""
    column, row = _on_map(terrain, xy)
    return _raster.bilinear(terrain, row, column)


def known(terrain: TerrainMap, xy: jax.Array) -> jax.Array:
    """Whether the map is known at points `[..., 2]` p_world, m: `[...]` bool."""
    if terrain.observed is None:
        return jnp.ones(xy.shape[:-1], bool)
    column, row = _on_map(terrain, xy)
    return _raster.known(terrain, terrain.observed.known, row, column)


def _on_map(terrain: TerrainMap, xy: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Points to fractional (column, row) of the vertices, on the map."""
    column = (xy[..., 0] - terrain.origin[0]) / terrain.resolution
    row = (terrain.origin[1] - xy[..., 1]) / terrain.resolution
    return _raster.on_map(terrain, column, row)
