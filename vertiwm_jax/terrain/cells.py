"""What linear maps make of the cells of a patch, such as the first layers of encoders.

Where a map is no finer than a cell of 0.8 m, as Verti-Bench's and the procedural ones, a cell has
at most 3 x 3 vertices and 2 x 2 classes around it. A CPU reads these alone and computes the pixels
between them: gathers are what it does slowest. Few cells have a border of classes in them, and
pixels of one colour need not be drawn.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

from vertiwm_jax.terrain import grid, patches
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.patches import CELL_PIXELS, RELIEF_METRES

_DIFFERENCES = np.array([[1, 0, 0], [-1, 1, 0], [1, -2, 1]])
# Three heights h at 0, 1 and 2 are, between them, a0 + a1 x + a2 max(x - 1, 0), a = _DIFFERENCES h.
_HINGES = np.kron(_DIFFERENCES, _DIFFERENCES).T.astype(np.float32)
_BYTES = np.array([0, 8, 16])  # of red, green and blue in a colour
_DRAWN_TOGETHER = 128  # cells with borders
_SIDE = patches.PATCH_PIXELS // CELL_PIXELS // 2
_FOURS = patches.CELLS_OF_PATCH.reshape(2, _SIDE, 2, _SIDE, 2).swapaxes(2, 3).reshape(2, -1)


@partial(jax.jit, inline=True)
def projections(
    terrain: TerrainMap,
    position: jax.Array,
    yaw: jax.Array,
    of_elevation: jax.Array,
    of_colours: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Linear maps `[64, F]` and `[3, 64, F]` of every cell's pixels: `[8, 8, 4, F]` of each.

    To rounding what they make of `patches.query`, which has the other arguments. No gradient flows.
    Cells come four by four, row by row of each 2 x 2, as encoders go on with them.
    """
    of_elevation, of_colours = jax.lax.stop_gradient((of_elevation, of_colours))
    position, yaw = jax.lax.stop_gradient((position, yaw))
    middles, around = patches.places(terrain, position, yaw, _FOURS)

    def of_pixels() -> tuple[jax.Array, jax.Array]:
        elevation, rgb = patches.pixels(terrain, middles, around, position[2])
        return elevation @ of_elevation, jnp.einsum("ncp,cpf->nf", rgb, of_colours)

    def of_cells(*read: Any) -> tuple[jax.Array, jax.Array]:
        heights, place, least, most, colours, border, around = read
        elevation = _draw_heights(heights, place, least, most, around)
        of_each = _of_colours(colours[None], border[None], around[None], of_colours)
        return elevation @ of_elevation, of_each[0]

    if _can_be_coarse(terrain):
        # Operands of a branch are computed once, where fusion would repeat them for all pixels.
        operands = (
            *_read_heights(terrain, middles, around, position[2]),
            *_read_colours(terrain, middles, around),
            around,
        )
        found = jax.lax.platform_dependent(
            cpu=lambda: jax.lax.cond(
                _is_coarse(terrain), of_cells, lambda *_: of_pixels(), *operands
            ),
            default=of_pixels,
        )
    else:
        found = of_pixels()
    elevation, colours = (x.reshape(_SIDE, _SIDE, 4, -1) for x in found)
    return elevation, colours


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
    widest = np.sqrt(2) * (CELL_PIXELS - 1) * patches.PIXEL_METRES
    return spacing * terrain.resolution > widest


def _first(middles: jax.Array, around: jax.Array, last: np.ndarray) -> jax.Array:
    """`[2, 256]` the least fractional column and row in each cell, on a map that ends at `last`."""
    return jnp.clip(middles - jnp.max(around, axis=1, keepdims=True), 0, last)


def _read_heights(
    terrain: TerrainMap,
    middles: jax.Array,
    around: jax.Array,
    height: jax.Array,
) -> tuple[jax.Array, ...]:
    """The surface through the 3 x 3 vertices around each cell.

    `[256, 9]` elevations of it, by `_HINGES`; `[2, 256]` columns and rows of the middle of the
    cell from the first of the vertices; and `[2, 256]` twice, where the map begins and ends.
    """
    _, rows, columns = terrain.elevation.shape
    last = np.array([[columns - 1], [rows - 1]])
    first = jnp.minimum(_first(middles, around, last).astype(jnp.int32), last - 2)
    vertices = grid.flat_index(terrain, rows, columns, first[1], first[0])[:, None]
    vertices += (columns * np.arange(3)[:, None] + np.arange(3)).ravel()
    heights = (grid.gather(terrain.elevation, vertices) - height) / RELIEF_METRES
    surface = jnp.dot(heights, _HINGES, precision="highest")
    return surface, middles - first, jnp.float32(-first), jnp.float32(last - first)


def _draw_heights(
    surface: jax.Array, place: jax.Array, least: jax.Array, most: jax.Array, around: jax.Array
) -> jax.Array:
    """Elevations `[256, 64]` of what `_read_heights` gave."""
    place = place[..., None] + around[:, None]
    x, y = jnp.clip(place, least[..., None], most[..., None])
    beyond_x, beyond_y = jnp.maximum(x - 1, 0), jnp.maximum(y - 1, 0)
    h = surface[..., None]
    flat, slope, bend = (h[:, i] + x * h[:, i + 1] + beyond_x * h[:, i + 2] for i in (0, 3, 6))
    return jnp.clip(flat + y * slope + beyond_y * bend, -1, 1)


def _read_colours(
    terrain: TerrainMap, middles: jax.Array, around: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The 2 x 2 classes around each cell.

    `[256, 4]` int32 colours of them, a byte each for red, green and blue; and `[256, 2]` columns
    and rows from the middle of the cell to where the second ones begin.
    """
    _, rows, columns = terrain.elevation.shape
    _, class_rows, class_columns = terrain.semantic.shape
    last = np.array([[columns - 1], [rows - 1]])
    last_class = np.array([[class_columns - 1], [class_rows - 1]])
    classes_a_vertex = ((last_class + 1) / last).astype(np.float32)
    least = _first(middles, around, last) * classes_a_vertex
    first = jnp.minimum(least.astype(jnp.int32), last_class - 1)
    classes = grid.flat_index(terrain, class_rows, class_columns, first[1], first[0])[:, None]
    classes += (class_columns * np.arange(2)[:, None] + np.arange(2)).ravel()
    palette = jnp.sum(terrain.class_rgb.astype(jnp.int32) << _BYTES, axis=1)
    colours = grid.gather(palette, grid.gather(terrain.semantic, classes).astype(jnp.int32))
    return colours, ((first + 1) / classes_a_vertex - middles).T


@custom_vmap
def _of_colours(
    colours: jax.Array, border: jax.Array, around: jax.Array, projection: jax.Array
) -> jax.Array:
    """A linear map `[3, 64, F]` of the pixels of V patches `[V, 256, ...]`: `[V, 256, F]`.

    Cells in which all pixels are alike have the sum of the map; others are drawn, some at a time,
    whichever patches they are of.
    """
    number, size = colours[..., 0].size, colours.shape[1]
    reach = jnp.max(jnp.abs(around), axis=-1)[:, None]
    beside, below = jnp.moveaxis(jnp.abs(border) <= reach, -1, 0)
    here, right, under, across = jnp.moveaxis(colours, -1, 0)
    mixed = beside & ((here != right) | (under != across))
    mixed |= below & ((here != under) | (right != across))
    colours, border, mixed = colours.reshape(number, 4), border.reshape(number, 2), mixed.ravel()
    middles = _draw_colours(colours, border, jnp.zeros((1, 2, 1)))[..., 0]
    found = jnp.dot(middles, jnp.sum(projection, axis=1), precision="highest")

    drawn = jnp.sum(mixed)
    (where,) = jnp.nonzero(mixed, size=number, fill_value=number)

    def some(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        done, found = carry
        cells = jax.lax.dynamic_slice_in_dim(where, done, _DRAWN_TOGETHER)
        one = jnp.minimum(cells, number - 1)  # of those that only fill up
        rgb = _draw_colours(colours[one], border[one], around[one // size])
        projected = jnp.einsum("ncp,cpf->nf", rgb, projection)
        return done + _DRAWN_TOGETHER, found.at[cells].set(projected, mode="drop")

    begin = jnp.zeros_like(drawn), found
    found = jax.lax.while_loop(lambda carry: carry[0] < drawn, some, begin)[1]
    return found.reshape(-1, size, projection.shape[-1])


@_of_colours.def_vmap
def _of_many(size: int, batched: list[bool], *args: jax.Array) -> tuple[jax.Array, bool]:
    """Of a batch of batches of patches: those of one."""
    *patches, projection = (
        arg if mapped or i == 3 else jnp.broadcast_to(arg, (size, *arg.shape))
        for i, (arg, mapped) in enumerate(zip(args, batched, strict=True))
    )
    if batched[3]:
        return jax.lax.map(lambda each: _of_colours(*each), (*patches, projection)), True
    found = _of_colours(*(x.reshape(-1, *x.shape[2:]) for x in patches), projection)
    return found.reshape(size, -1, *found.shape[1:]), True


def _draw_colours(colours: jax.Array, border: jax.Array, around: jax.Array) -> jax.Array:
    """`[N, 3, P]` of what `_read_colours` gave of N cells, at places around them `[N, 2, P]`."""
    right, below = jnp.moveaxis(around >= border[..., None], 1, 0)
    here, beside, under, across = jnp.moveaxis(colours[..., None], 1, 0)
    upper, lower = jnp.where(right, beside, here), jnp.where(right, across, under)
    colour = jnp.where(below, lower, upper)[:, None]
    return (colour >> _BYTES[:, None] & 255) / 127.5 - 1
