"""Vehicle-aligned patches of the map, as encoders read them: cells of 8 x 8 pixels.

Any map can be read pixel by pixel. Where it is no finer than a cell of 0.8 m, as Verti-Bench's and
the procedural ones, a cell has at most 3 x 3 vertices and 2 x 2 classes around it. A CPU reads
these alone and computes the pixels between them: gathers are what it does slowest.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.state import CELL_PIXELS, STEP_SECONDS, Patches
from vertiwm_jax.terrain import grid
from vertiwm_jax.terrain.map import TerrainMap

PATCH_PIXELS = 128
PATCH_METRES = 12.8
RELIEF_METRES = 4.0
"""Height above or below the vehicle that is 1 in patches relative to it."""

_PIXEL_METRES = PATCH_METRES / PATCH_PIXELS
_CELLS = PATCH_PIXELS // CELL_PIXELS
_BYTES = np.array([[0], [8], [16]])  # of red, green and blue in a colour


def _square(number: int, metres: float) -> np.ndarray:
    """`[2, number**2]` m ahead and to the left of the middle of a square, from its front left."""
    offset = ((number - 1) / 2 - np.arange(number)) * metres
    return np.stack(np.meshgrid(offset, offset, indexing="ij")).reshape(2, -1).astype(np.float32)


_CELLS_OF_PATCH = _square(_CELLS, CELL_PIXELS * _PIXEL_METRES)
_PIXELS_OF_CELL = _square(CELL_PIXELS, _PIXEL_METRES)

_DIFFERENCES = np.array([[1, 0, 0], [-1, 1, 0], [1, -2, 1]])
# Three heights h at 0, 1 and 2 are, between them, a0 + a1 x + a2 max(x - 1, 0), a = _DIFFERENCES h.
_HINGES = np.kron(_DIFFERENCES, _DIFFERENCES).T.astype(np.float32)


@dataclass(frozen=True)
class PatchConfig:
    """How heights become elevation patches.

    reference: "map" scales the map's `elevation_range` to [-1, 1], as the paper does; "vehicle"
        takes heights above the body origin, over `RELIEF_METRES`, which do not change when map
        and vehicle are lifted together.
    interpolation: "nearest" vertex, as in the paper, which draws a coarse grid as stairs; or
        "bilinear" between vertices.
    """

    reference: Literal["map", "vehicle"] = "map"
    interpolation: Literal["nearest", "bilinear"] = "nearest"


@partial(jax.jit, static_argnames="config", inline=True)
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
    if config.reference == "map":
        low, high = terrain.elevation_range
        level, relief = (low + high) / 2, (high - low) / 2
    else:
        level, relief = position[2], RELIEF_METRES
    cells, pixels = _places(terrain, position, yaw)

    def read_pixels() -> tuple[jax.Array, jax.Array]:
        column, row = grid.on_map(terrain, *(cells[:, :, None] + pixels[:, None]))
        read = grid.nearest if config.interpolation == "nearest" else grid.bilinear
        elevation = jnp.clip((read(terrain, row, column) - level) / relief, -1, 1)
        semantic = grid.classes(terrain, row, column, grid.cell_index(terrain, row, column))
        palette = terrain.class_rgb / 127.5 - 1
        return elevation, jnp.stack([grid.gather(c, semantic) for c in palette.T], axis=1)

    if config.interpolation == "bilinear" and _can_be_coarse(terrain):
        # Operands of a branch are computed once, where fusion would repeat them for all pixels.
        around = _read_cells(terrain, cells, pixels, level, relief)
        elevation, rgb = jax.lax.platform_dependent(
            cpu=lambda: jax.lax.cond(
                _is_coarse(terrain), _draw_pixels, lambda *_: read_pixels(), around, pixels
            ),
            default=read_pixels,
        )
    else:
        elevation, rgb = read_pixels()
    return Patches(_image(elevation[:, None])[..., 0], _image(rgb))


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


def _places(
    terrain: TerrainMap, position: jax.Array, yaw: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Fractional columns and rows `[2, 256]` of the cells' middles, and from there `[2, 64]`."""
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    x, y = position[0] - terrain.origin[0], terrain.origin[1] - position[1]
    turn = jnp.array([[cos, -sin], [-sin, -cos]]) / terrain.resolution
    origin = jnp.stack([x, y])[:, None] / terrain.resolution
    # Matmuls in full precision: anything else would be fused, sine and cosine for every pixel.
    cells = jnp.dot(turn, _CELLS_OF_PATCH, precision="highest") + origin
    pixels = jnp.dot(turn, _PIXELS_OF_CELL, precision="highest")
    lost = jnp.isnan(cells[:, :1])
    return jnp.where(lost, 0.0, cells), jnp.where(lost, 0.0, pixels)


def _can_be_coarse(terrain: TerrainMap) -> bool:
    """Whether there are 3 x 3 vertices and 2 x 2 classes at all, and all of them are known."""
    vertices, classes = terrain.elevation.shape[1:], terrain.semantic.shape[1:]
    if not all(isinstance(number, int) for number in vertices + classes):
        return False  # An export takes maps of any size.
    return terrain.belief is None and min(vertices) >= 3 and min(classes) >= 2


def _is_coarse(terrain: TerrainMap) -> jax.Array:
    """`[]` whether no cell, however turned, reaches beyond 3 x 3 vertices or 2 x 2 classes."""
    vertices, classes = np.array(terrain.elevation.shape[1:]), np.array(terrain.semantic.shape[1:])
    spacing = float(np.min(np.append((vertices - 1) / classes, 1.0)))  # in units of the resolution
    widest = np.sqrt(2) * (CELL_PIXELS - 1) * _PIXEL_METRES
    return spacing * terrain.resolution > widest


@struct.dataclass
class _Around:
    """What lies around the 256 cells of a patch, in columns and rows of the map.

    place: `[2, 256]` of the middle of a cell, counted from the first of 3 x 3 vertices around it.
    least, most: `[2, 256]` where the map ends, counted likewise.
    border: `[2, 256]` from the middle of a cell to where the second of 2 x 2 classes begins.
    heights: `[256, 9]` of the surface through the vertices, by `_HINGES`, as elevations.
    colours: `[256, 4]` int32 of the classes, a byte each for red, green and blue.
    """

    place: jax.Array
    least: jax.Array
    most: jax.Array
    border: jax.Array
    heights: jax.Array
    colours: jax.Array


def _read_cells(
    terrain: TerrainMap,
    cells: jax.Array,
    pixels: jax.Array,
    level: jax.Array,
    relief: jax.Array | float,
) -> _Around:
    _, rows, columns = terrain.elevation.shape
    _, class_rows, class_columns = terrain.semantic.shape
    last = np.array([[columns - 1], [rows - 1]])
    last_class = np.array([[class_columns - 1], [class_rows - 1]])
    classes_a_vertex = ((last_class + 1) / last).astype(np.float32)

    least = jnp.clip(cells - jnp.max(pixels, axis=1, keepdims=True), 0, last)
    first = jnp.minimum(least.astype(jnp.int32), last - 2)
    first_class = jnp.minimum((least * classes_a_vertex).astype(jnp.int32), last_class - 1)
    vertices = grid.flat_index(terrain, rows, columns, first[1], first[0])[:, None]
    vertices += (columns * np.arange(3)[:, None] + np.arange(3)).ravel()
    classes = grid.flat_index(terrain, class_rows, class_columns, first_class[1], first_class[0])
    classes = classes[:, None] + (class_columns * np.arange(2)[:, None] + np.arange(2)).ravel()
    heights = (grid.gather(terrain.elevation, vertices) - level) / relief
    palette = jnp.sum(terrain.class_rgb.astype(jnp.int32) << _BYTES.T, axis=1)
    return _Around(
        place=cells - first,
        least=jnp.float32(-first),
        most=jnp.float32(last - first),
        border=(first_class + 1) / classes_a_vertex - cells,
        heights=jnp.dot(heights, _HINGES, precision="highest"),
        colours=grid.gather(palette, grid.gather(terrain.semantic, classes).astype(jnp.int32)),
    )


def _draw_pixels(around: _Around, pixels: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Elevations `[256, 64]` and colours `[256, 3, 64]`."""
    place = around.place[..., None] + pixels[:, None]
    x, y = jnp.clip(place, around.least[..., None], around.most[..., None])
    beyond_x, beyond_y = jnp.maximum(x - 1, 0), jnp.maximum(y - 1, 0)
    h = around.heights[..., None]
    flat, slope, bend = (h[:, i] + x * h[:, i + 1] + beyond_x * h[:, i + 2] for i in (0, 3, 6))
    elevation = jnp.clip(flat + y * slope + beyond_y * bend, -1, 1)

    right, below = pixels[:, None, None] >= around.border[..., None, None]
    colours = (around.colours[:, None] >> _BYTES & 255) / 127.5 - 1
    here, beside, under, across = jnp.moveaxis(colours[..., None], 2, 0)
    upper, lower = jnp.where(right, beside, here), jnp.where(right, across, under)
    return elevation, jnp.where(below, lower, upper)


def _image(cells: jax.Array) -> jax.Array:
    """Pixels `[256, C, 64]`, cell by cell, to the image `[128, 128, C]`."""
    channels = cells.shape[1]
    squares = cells.reshape(_CELLS, _CELLS, channels, CELL_PIXELS, CELL_PIXELS)
    return squares.transpose(0, 3, 1, 4, 2).reshape(PATCH_PIXELS, PATCH_PIXELS, channels)
