"""Asking the map: vehicle-aligned patches, and the ground under points.

Every gather is a flat index into the stacked worlds, clipped first and then promised in bounds,
so that a batch of vehicles on different worlds is one gather and copies no map. Outside the map
the ground continues level from its edge; a NaN coordinate reads the first row or column. Where
a map has a belief, what it does not know is answered by what it guesses.
"""

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.state import CELL_PIXELS, STEP_SECONDS, Patches
from vertiwm_jax.terrain.belief import MapBelief
from vertiwm_jax.terrain.map import TerrainMap

PATCH_PIXELS = 128
PATCH_METRES = 12.8
RELIEF_METRES = 4.0
"""Height above or below the vehicle that is 1 in patches relative to it."""


def _pixels() -> np.ndarray:
    """`[3, P]` m ahead, m to the left, and 1, of the pixels of a patch, cell by cell.

    As encoders read them: what rearranges them to an image and back cancels when both are
    compiled together.
    """
    offset = ((PATCH_PIXELS - 1) / 2 - np.arange(PATCH_PIXELS)) * PATCH_METRES / PATCH_PIXELS
    cells = offset.reshape(-1, CELL_PIXELS)
    ahead, left = np.broadcast_arrays(cells[:, None, :, None], cells[None, :, None, :])
    return np.stack([ahead.ravel(), left.ravel(), np.ones(offset.size**2)]).astype(np.float32)


_PIXELS = _pixels()


@dataclass(frozen=True)
class PatchConfig:
    """How heights become elevation patches.

    reference: "map" scales the map's `elevation_range` to [-1, 1], as the paper does; "vehicle"
        takes heights above the body origin, over `RELIEF_METRES`, which do not change when map
        and vehicle are lifted together.
    interpolation: "nearest" vertex, as in the paper, which draws a coarse grid as stairs; or
        "bilinear" between vertices, at four times the reads.
    """

    reference: Literal["map", "vehicle"] = "map"
    interpolation: Literal["nearest", "bilinear"] = "nearest"


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


def patches(
    terrain: TerrainMap, position: jax.Array, yaw: jax.Array, config: PatchConfig = PatchConfig()
) -> Patches:
    """What one vehicle at `[3]` p_world (m) and `[]` yaw (rad) sees, in [-1, 1] (Eq. 1's m_t).

    Pixels are 0.1 m, row 0 farthest ahead, column 0 farthest left, the vehicle midway between
    the four central ones; each has the colour of its cell. Pixels off the map take the nearest
    edge; a NaN x, y or yaw sees vertex (0, 0) in every pixel, a NaN height NaN elevations where
    they are relative to it. No gradient flows to the pose: it counts as given. Batch with `vmap`,
    selecting each vehicle's world inside.
    """
    position, yaw = jax.lax.stop_gradient((position, yaw))
    column, row = _pixel_coordinates(terrain, position, yaw)
    if config.interpolation == "nearest":
        heights = _nearest(terrain, row, column)
    else:
        heights = _bilinear(terrain, row, column)
    if config.reference == "map":
        low, high = terrain.elevation_range
        elevation = 2 * (heights - low) / (high - low) - 1
    else:
        elevation = (heights - position[2]) / RELIEF_METRES
    palette = jnp.clip(terrain.class_rgb.astype(jnp.float32) / 127.5 - 1, -1, 1)
    semantic = _classes(terrain, row, column, _cell_index(terrain, row, column))
    rgb = [_image(_gather(colours, semantic)) for colours in palette.T]
    return Patches(_image(jnp.clip(elevation, -1, 1)), jnp.stack(rgb, axis=-1))


def surface(terrain: TerrainMap, xy: jax.Array) -> Surface:
    """The ground as wheels meet it at points `[..., 2]` p_world, m.

    Between vertices, soil is bilinear and rigid ground is two triangles split from bottom left
    to top right, as Chrono builds them. Differentiable: the gradient of `height` with respect
    to `xy` is `gradient`.
    """
    column, row = _grid_coordinates(terrain, xy[..., 0], xy[..., 1])
    cell = _cell_index(terrain, row, column)
    semantic = _classes(terrain, row, column, cell)
    soft = _gather(terrain.deformable, semantic)
    bottom_left, along, up, twist, fx, fy = _corners(terrain, row, column)
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
    gradient = jnp.where(_inside(terrain, xy), gradient, 0.0)
    friction = _gather(terrain.friction, cell)
    if terrain.grip is not None:
        friction = terrain.grip * friction
    if terrain.belief is not None:
        known = _known(terrain, terrain.belief, row, column)
        friction = jnp.where(known, friction, terrain.belief.friction)
    return Surface(height, gradient, semantic, friction)


def height(terrain: TerrainMap, xy: jax.Array) -> jax.Array:
    """`[..., 2]` p_world to `[...]` bilinear height, m, whatever the class."""
    column, row = _grid_coordinates(terrain, xy[..., 0], xy[..., 1])
    return _bilinear(terrain, row, column)


def known(terrain: TerrainMap, xy: jax.Array) -> jax.Array:
    """Whether the map is known at points `[..., 2]` p_world, m: `[...]` bool."""
    if terrain.belief is None:
        return jnp.ones(xy.shape[:-1], bool)
    column, row = _grid_coordinates(terrain, xy[..., 0], xy[..., 1])
    return _known(terrain, terrain.belief, row, column)


def normal(gradient: jax.Array) -> jax.Array:
    """`[..., 2]` gradient to the `[..., 3]` unit normal of the ground, pointing up."""
    up = jnp.concatenate([-gradient, jnp.ones_like(gradient[..., :1])], axis=-1)
    return up / jnp.linalg.norm(up, axis=-1, keepdims=True)


def footprint_covered(
    wheel_reach: float, top_speed: float, step_seconds: float = STEP_SECONDS
) -> None:
    """Raises unless a patch covers the wheels of the next pose (Sec. III-A), at any heading.

    wheel_reach: m from the body origin to the farthest ground a wheel can touch.
    top_speed: m/s, the largest in any direction.
    """
    needed, covered = wheel_reach + top_speed * step_seconds, PATCH_METRES / 2
    if not needed <= covered:
        fastest = (covered - wheel_reach) / step_seconds
        raise ValueError(
            f"patch: expected {PATCH_METRES} m to cover the wheels of the next pose, found a reach "
            f"of {wheel_reach:g} m + {top_speed:g} m/s x {step_seconds:g} s = {needed:g} m "
            f"> {covered:g} m; keep the top speed below {fastest:g} m/s"
        )


def _grid_coordinates(
    terrain: TerrainMap, x: jax.Array, y: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Points to fractional (column, row) of the vertices, on the map."""
    column = (x - terrain.origin[0]) / terrain.resolution
    row = (terrain.origin[1] - y) / terrain.resolution
    return _on_map(terrain, column, row)


def _pixel_coordinates(
    terrain: TerrainMap, position: jax.Array, yaw: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The same of all pixels of the patch at a pose, cell by cell."""
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    x, y = position[0] - terrain.origin[0], terrain.origin[1] - position[1]
    # One matmul, in full precision: fused with gathers, this would be done twice, and sine and
    # cosine for every pixel.
    to_grid = jnp.array([[cos, -sin, x], [-sin, -cos, y]]) / terrain.resolution
    column, row = jnp.dot(to_grid, _PIXELS, precision="highest")
    return _on_map(terrain, column, row)


def _on_map(terrain: TerrainMap, column: jax.Array, row: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Fractional (column, row), or those of the nearest edge; NaN becomes 0."""
    _, rows, columns = terrain.elevation.shape
    # `where` and not `clip`: NaN becomes 0, and its gradient too.
    column = jnp.minimum(jnp.where(column > 0, column, 0.0), columns - 1.0)
    row = jnp.minimum(jnp.where(row > 0, row, 0.0), rows - 1.0)
    return column, row


def _image(pixels: jax.Array) -> jax.Array:
    """Pixels `[P]`, cell by cell, to the image `[128, 128]`."""
    cells = PATCH_PIXELS // CELL_PIXELS
    pixels = pixels.reshape(cells, cells, CELL_PIXELS, CELL_PIXELS)
    return jnp.swapaxes(pixels, 1, 2).reshape(PATCH_PIXELS, PATCH_PIXELS)


def _inside(terrain: TerrainMap, xy: jax.Array) -> jax.Array:
    """`[..., 2]` whether each coordinate is within the map's extent."""
    _, rows, columns = terrain.elevation.shape
    extent = terrain.resolution * jnp.array([columns - 1.0, rows - 1.0])
    from_corner = (xy - terrain.origin) * jnp.array([1.0, -1.0])
    return (from_corner >= 0) & (from_corner <= extent)


def _flat_index(
    terrain: TerrainMap, rows: int, columns: int, row: jax.Array, column: jax.Array
) -> jax.Array:
    return (terrain.world * rows + row) * columns + column


def _gather(table: jax.Array, index: jax.Array) -> jax.Array:
    flat = table.reshape(-1)
    return flat.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _cell_index(terrain: TerrainMap, row: jax.Array, column: jax.Array) -> jax.Array:
    """The class cell that contains fractional vertex coordinates on the map."""
    _, cell_rows, cell_columns = terrain.semantic.shape
    i, j = _cell(terrain, cell_rows, cell_columns, row, column)
    return _flat_index(terrain, cell_rows, cell_columns, i, j)


def _cell(
    terrain: TerrainMap, cell_rows: int, cell_columns: int, row: jax.Array, column: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Which of the cells that tile the map contains fractional vertex coordinates on it."""
    _, rows, columns = terrain.elevation.shape
    i = jnp.minimum((row * (cell_rows / (rows - 1))).astype(jnp.int32), cell_rows - 1)
    j = jnp.minimum((column * (cell_columns / (columns - 1))).astype(jnp.int32), cell_columns - 1)
    return i, j


def _known(terrain: TerrainMap, belief: MapBelief, row: jax.Array, column: jax.Array) -> jax.Array:
    """Whether the belief knows the map at fractional vertex coordinates on it."""
    cell_rows, cell_columns = belief.known.shape
    i, j = _cell(terrain, cell_rows, cell_columns, row, column)
    return _gather(belief.known, i * cell_columns + j)


def _classes(terrain: TerrainMap, row: jax.Array, column: jax.Array, cell: jax.Array) -> jax.Array:
    """int32 class ids at fractional vertex coordinates on the map, which lie in the cells."""
    semantic = _gather(terrain.semantic, cell).astype(jnp.int32)
    belief = terrain.belief
    if belief is None:
        return semantic
    return jnp.where(_known(terrain, belief, row, column), semantic, belief.semantic)


def _vertices(
    terrain: TerrainMap, row: jax.Array, column: jax.Array, index: jax.Array
) -> jax.Array:
    """Heights of the vertices in the rows and columns, at the index, m."""
    heights = _gather(terrain.elevation, index)
    belief = terrain.belief
    if belief is None:
        return heights
    x = terrain.origin[0] + column * terrain.resolution
    y = terrain.origin[1] - row * terrain.resolution
    guess = belief.plane[0] + belief.plane[1] * x + belief.plane[2] * y
    return jnp.where(_known(terrain, belief, row, column), heights, guess)


def _nearest(terrain: TerrainMap, row: jax.Array, column: jax.Array) -> jax.Array:
    """Heights of the vertices next to fractional coordinates on the map, m."""
    _, rows, columns = terrain.elevation.shape
    nearest_row, nearest_column = (row + 0.5).astype(jnp.int32), (column + 0.5).astype(jnp.int32)
    index = _flat_index(terrain, rows, columns, nearest_row, nearest_column)
    return _vertices(terrain, nearest_row, nearest_column, index)


def _bilinear(terrain: TerrainMap, row: jax.Array, column: jax.Array) -> jax.Array:
    """Heights at fractional coordinates on the map, bilinear between vertices, m."""
    bottom_left, along, up, twist, fx, fy = _corners(terrain, row, column)
    return bottom_left + fx * along + fy * up + twist * fx * fy


def _corners(terrain: TerrainMap, row: jax.Array, column: jax.Array) -> tuple[jax.Array, ...]:
    """The vertex cell around a point: its corner, edges, twist, and the point's place in it.

    The bilinear height is bottom_left + fx along + fy up + fx fy twist.
    """
    _, rows, columns = terrain.elevation.shape
    r = jnp.minimum(row.astype(jnp.int32), rows - 2)
    c = jnp.minimum(column.astype(jnp.int32), columns - 2)
    fx, fy = column - c, 1.0 - (row - r)
    top = _flat_index(terrain, rows, columns, r, c)
    bottom = top + columns
    top_left = _vertices(terrain, r, c, top)
    top_right = _vertices(terrain, r, c + 1, top + 1)
    bottom_left = _vertices(terrain, r + 1, c, bottom)
    bottom_right = _vertices(terrain, r + 1, c + 1, bottom + 1)
    along, up = bottom_right - bottom_left, top_left - bottom_left
    return bottom_left, along, up, top_right - top_left - along, fx, fy
