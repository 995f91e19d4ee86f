"""What `perceive` gives, fast on CPUs.

Where a map is no finer than a cell of 0.8 m, as Verti-Bench's and the procedural ones, a cell of a
patch has at most 3 x 3 vertices and 2 x 2 classes around it. A CPU reads these alone and computes
the pixels between them, because gathers are what it does slowest. The first layer of encoders is
linear in the pixels of a cell. Few cells have a border of classes in them, and pixels of one color
need not be drawn. Vehicles look in turns of about 16, whose patches stay near a core.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache, partial
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.custom_batching import custom_vmap

from vertiwm_jax.networks.encoder import LATENT_CHANNELS
from vertiwm_jax.perception.features import Encoders, TerrainFeatures, features
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain import _raster, patches
from vertiwm_jax.terrain.map import ObservedMap, TerrainMap
from vertiwm_jax.terrain.patches import CELL_PIXELS, RELIEF_METERS
from vertiwm_jax.terrain.ruts import Ruts

Shared = tuple[tuple[Encoders, ...], TerrainMap]
"""What all vehicles of a batch have in common: weights, and a map without what is not seen."""
_SEEN = ("elevation", "semantic", "origin", "resolution", "class_rgb")
_TOGETHER = 16  # vehicles, whose patches have 260 kB each
_DRAWN_TOGETHER = 128  # cells with borders
_DIFFERENCES = np.array([[1, 0, 0], [-1, 1, 0], [1, -2, 1]])
# Three heights h at 0, 1 and 2 are, between them, a0 + a1 x + a2 max(x - 1, 0), a = _DIFFERENCES h.
_HINGES = np.kron(_DIFFERENCES, _DIFFERENCES).T.astype(np.float32)
_BYTES = np.array([0, 8, 16])  # of red, green and blue in a color
_SIDE = patches.PATCH_PIXELS // CELL_PIXELS // 2
# Cells four by four, row by row of each 2 x 2, as encoders go on with them.
_FOURS = patches.CELLS_OF_PATCH.reshape(2, _SIDE, 2, _SIDE, 2).swapaxes(2, 3).reshape(2, -1)


@struct.dataclass
class _Vehicles:
    """What each of V vehicles has of its own; leaves `[V, ...]`.

    world: on which they are; observed: what they know of it, or None; ruts: that they have left
    there, or None; position: m; yaw: rad.
    """

    world: jax.Array
    observed: ObservedMap | None
    ruts: Ruts | None
    position: jax.Array
    yaw: jax.Array

    def on(self, terrain: TerrainMap) -> TerrainMap:
        """The map as one of them, leaves `[...]`, has it."""
        return replace(terrain, world=self.world, observed=self.observed, ruts=self.ruts)


def look(
    encoders: tuple[Encoders, ...], terrain: TerrainMap, state: VehicleState, latents: bool
) -> tuple[TerrainFeatures, ...]:
    """What `perceive` gives for one vehicle, to rounding."""
    hidden = {field.name: None for field in fields(TerrainMap) if field.name not in _SEEN}
    seen = replace(terrain, **hidden)
    own = terrain.world, terrain.observed, terrain.ruts
    vehicle = _Vehicles(*own, state.position, state.rpy[2])
    alone = jax.tree.map(lambda x: x[None], vehicle)
    found = _batched(latents)((encoders, seen), alone)
    return jax.tree.map(lambda x: x[0], found)


@cache  # one for each, so that what was traced is found again
def _batched(latents: bool) -> Callable[[Shared, _Vehicles], tuple[TerrainFeatures, ...]]:
    """The look of V vehicles at once, whose batches are more vehicles."""

    @custom_vmap
    def of_all(shared: Shared, vehicles: _Vehicles) -> tuple[TerrainFeatures, ...]:
        return _in_turns(lambda some: _look(*shared, some, latents), vehicles)

    @of_all.def_vmap
    def of_batch(size: int, batched: Any, shared: Shared, vehicles: _Vehicles) -> tuple[Any, Any]:
        vehicles = jax.tree.map(
            lambda x, of_each: x if of_each else jnp.broadcast_to(x, (size, *x.shape)),
            vehicles,
            batched[1],
        )
        if any(jax.tree.leaves(batched[0])):  # Several models or maps go one after the other.

            def one(i: jax.Array) -> tuple[TerrainFeatures, ...]:
                own = jax.tree.map(lambda x, of_each: x[i] if of_each else x, shared, batched[0])
                return of_all(own, jax.tree.map(lambda x: x[i], vehicles))

            found = jax.lax.map(one, jnp.arange(size))
        else:
            merged = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), vehicles)
            found = of_all(shared, merged)
            found = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), found)
        return found, jax.tree.map(lambda _: True, found)

    return of_all


def _in_turns(
    look: Callable[[_Vehicles], tuple[TerrainFeatures, ...]], vehicles: _Vehicles
) -> tuple[TerrainFeatures, ...]:
    """The look of V vehicles, about `_TOGETHER` of them at a time.

    One operation of all vehicles after the other would send all of their patches to memory and
    back between any two.
    """
    number = len(vehicles.yaw)
    turns = max(1, round(number / _TOGETHER))
    if turns == 1:
        return look(vehicles)
    some = -(-number // turns)
    rows = np.arange(turns * some) % number  # The last turn may look again for some of the first.
    if len(rows) > number:
        vehicles = jax.tree.map(lambda x: x[rows], vehicles)
    parts = jax.tree.map(lambda x: x.reshape(turns, some, *x.shape[1:]), vehicles)
    found = jax.lax.map(look, parts)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:number], found)


def _look(
    encoders: tuple[Encoders, ...], terrain: TerrainMap, vehicles: _Vehicles, latents: bool
) -> tuple[TerrainFeatures, ...]:
    """What the pairs make of the same pixels: features, leaves `[V, ...]`."""
    kernels = (
        [kind["params"]["cell_kernel"] for kind in kinds]
        for kinds in zip(*((pair.elevation, pair.semantic) for pair in encoders), strict=True)
    )
    of_elevation, of_colors = (jnp.concatenate(kind, axis=-1) for kind in kernels)
    projected = _projections(terrain, vehicles, of_elevation[0], of_colors)
    of_each = zip(*(jnp.split(x, len(encoders), axis=-1) for x in projected), strict=True)
    seen = []
    for i, (pair, (elevation, semantic)) in enumerate(zip(encoders, of_each, strict=True)):
        read = partial(features, pair, keep=latents and i == 0, in_rows=_in_rows)
        both = _blocks(pair.elevation, elevation), _blocks(pair.semantic, semantic)
        seen.append(jax.vmap(read)(*both))
    return tuple(seen)


def _blocks(encoder: Any, projected: jax.Array) -> jax.Array:
    """The encoder from its first layer on: `[V, 8, 8, 4, 18]` to latents, in the same order.

    A convolution of 2 x 2 cells with strides of 2 is a matmul of cells that lie side by side.
    """
    weights = encoder["params"]
    halving, expand = weights["Conv_0"], weights["expand"]
    fours = projected.reshape(*projected.shape[:-2], -1) + jnp.tile(weights["cell_bias"], 4)
    kernel = halving["kernel"].reshape(fours.shape[-1], -1)
    coarse = nn.silu(fours @ kernel + halving["bias"])
    around = nn.Conv(weights["Conv_1"]["bias"].size, (3, 3))
    coarse = nn.silu(cast(jax.Array, around.apply({"params": weights["Conv_1"]}, coarse)))
    both = fours + (coarse @ expand["kernel"] + expand["bias"])
    return both.reshape(*both.shape[:-1], 4, LATENT_CHANNELS)


def _in_rows(fours: jax.Array) -> jax.Array:
    """`[8, 8, 4, c]`, row by row of each 2 x 2 cells, to `[16, 16, c]`."""
    squares = fours.reshape(_SIDE, _SIDE, 2, 2, -1)
    return jnp.swapaxes(squares, 1, 2).reshape(2 * _SIDE, 2 * _SIDE, -1)


def _projections(
    terrain: TerrainMap, vehicles: _Vehicles, of_elevation: jax.Array, of_colors: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Linear maps `[64, F]` and `[3, 64, F]` of every cell's pixels: `[V, 8, 8, 4, F]` of each."""

    def place(own: _Vehicles) -> tuple[jax.Array, jax.Array]:
        return patches.places(own.on(terrain), own.position, own.yaw, _FOURS)

    def draw(own: _Vehicles, middles: jax.Array, around: jax.Array) -> tuple[jax.Array, jax.Array]:
        return patches.pixels(own.on(terrain), middles, around, own.position[2])

    def read(own: _Vehicles, middles: jax.Array, around: jax.Array) -> tuple[jax.Array, ...]:
        known = own.on(terrain)
        heights = _read_heights(known, middles, around, own.position[2])
        return *heights, *_read_colors(known, middles, around)

    middles, around = jax.vmap(place)(vehicles)

    def of_pixels() -> tuple[jax.Array, jax.Array]:
        elevation, rgb = jax.vmap(draw)(vehicles, middles, around)
        return elevation @ of_elevation, jnp.einsum("vncp,cpf->vnf", rgb, of_colors)

    def pressed(own: _Vehicles, middles: jax.Array, around: jax.Array) -> jax.Array | None:
        return patches.pressed(own.on(terrain), middles, around)

    def of_cells(*about: jax.Array) -> tuple[jax.Array, jax.Array]:
        surface, middle, least, most, colors, border = about
        ruts = jax.vmap(pressed)(vehicles, middles, around)
        elevation = jax.vmap(_draw_heights)(surface, middle, least, most, around, ruts)
        return elevation @ of_elevation, _of_colors(colors, border, around, of_colors)

    if _can_be_coarse(terrain, vehicles):
        # Operands of a branch are computed once, where fusion would repeat them for all pixels.
        operands = jax.vmap(read)(vehicles, middles, around)
        found = jax.lax.cond(_is_coarse(terrain), of_cells, lambda *_: of_pixels(), *operands)
    else:
        found = of_pixels()
    elevation, colors = (x.reshape(-1, _SIDE, _SIDE, 4, x.shape[-1]) for x in found)
    return elevation, colors


def _can_be_coarse(terrain: TerrainMap, vehicles: _Vehicles) -> bool:
    """Whether there are 3 x 3 vertices and 2 x 2 classes at all, and all of them are known."""
    vertices, classes = terrain.elevation.shape[1:], terrain.semantic.shape[1:]
    if not all(isinstance(number, int) for number in vertices + classes):
        return False  # An export takes maps of any size.
    return vehicles.observed is None and min(vertices) >= 3 and min(classes) >= 2


def _is_coarse(terrain: TerrainMap) -> jax.Array:
    """`[]` whether no cell, however turned, reaches beyond 3 x 3 vertices or 2 x 2 classes."""
    vertices, classes = np.array(terrain.elevation.shape[1:]), np.array(terrain.semantic.shape[1:])
    spacing = float(np.min(np.append((vertices - 1) / classes, 1.0)))  # in units of the resolution
    widest = np.sqrt(2) * (CELL_PIXELS - 1) * patches.PIXEL_METERS
    return spacing * terrain.resolution > widest


def _first(middles: jax.Array, around: jax.Array, last: np.ndarray) -> jax.Array:
    """`[2, 256]` the least fractional column and row in each cell, on a map that ends at `last`."""
    return jnp.clip(middles - jnp.max(around, axis=1, keepdims=True), 0, last)


def _read_heights(
    terrain: TerrainMap, middles: jax.Array, around: jax.Array, height: jax.Array
) -> tuple[jax.Array, ...]:
    """The surface through the 3 x 3 vertices around each cell.

    `[256, 9]` elevations of it, by `_HINGES`; `[2, 256]` columns and rows of the middle of the
    cell from the first of the vertices; and `[2, 256]` twice, where the map begins and ends.
    """
    _, rows, columns = terrain.elevation.shape
    last = np.array([[columns - 1], [rows - 1]])
    first = jnp.minimum(_first(middles, around, last).astype(jnp.int32), last - 2)
    vertices = _raster.flat_index(terrain, rows, columns, first[1], first[0])[:, None]
    vertices += (columns * np.arange(3)[:, None] + np.arange(3)).ravel()
    heights = (_raster.gather(terrain.elevation, vertices) - height) / RELIEF_METERS
    surface = jnp.dot(heights, _HINGES, precision="highest")
    return surface, middles - first, jnp.float32(-first), jnp.float32(last - first)


def _draw_heights(
    surface: jax.Array,
    place: jax.Array,
    least: jax.Array,
    most: jax.Array,
    around: jax.Array,
    ruts: jax.Array | None,
) -> jax.Array:
    """Elevations `[256, 64]` of what `_read_heights` gave, without ruts `[256, 64]` m."""
    place = place[..., None] + around[:, None]
    x, y = jnp.clip(place, least[..., None], most[..., None])
    beyond_x, beyond_y = jnp.maximum(x - 1, 0), jnp.maximum(y - 1, 0)
    h = surface[..., None]
    flat, slope, bend = (h[:, i] + x * h[:, i + 1] + beyond_x * h[:, i + 2] for i in (0, 3, 6))
    drawn = flat + y * slope + beyond_y * bend
    return jnp.clip(drawn if ruts is None else drawn - ruts / RELIEF_METERS, -1, 1)


def _read_colors(
    terrain: TerrainMap, middles: jax.Array, around: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The 2 x 2 classes around each cell.

    `[256, 4]` int32 colors of them, a byte each for red, green and blue; and `[256, 2]` columns
    and rows from the middle of the cell to where the second ones begin.
    """
    _, rows, columns = terrain.elevation.shape
    _, class_rows, class_columns = terrain.semantic.shape
    last = np.array([[columns - 1], [rows - 1]])
    last_class = np.array([[class_columns - 1], [class_rows - 1]])
    classes_a_vertex = ((last_class + 1) / last).astype(np.float32)
    least = _first(middles, around, last) * classes_a_vertex
    first = jnp.minimum(least.astype(jnp.int32), last_class - 1)
    classes = _raster.flat_index(terrain, class_rows, class_columns, first[1], first[0])[:, None]
    classes += (class_columns * np.arange(2)[:, None] + np.arange(2)).ravel()
    palette = jnp.sum(terrain.class_rgb.astype(jnp.int32) << _BYTES, axis=1)
    colors = _raster.gather(palette, _raster.gather(terrain.semantic, classes).astype(jnp.int32))
    return colors, ((first + 1) / classes_a_vertex - middles).T


def _of_colors(
    colors: jax.Array, border: jax.Array, around: jax.Array, projection: jax.Array
) -> jax.Array:
    """A linear map `[3, 64, F]` of the pixels of V patches `[V, 256, ...]`: `[V, 256, F]`.

    Cells in which all pixels are alike have the sum of the map; others are drawn, some at a time,
    whichever patches they are of.
    """
    number, size = colors[..., 0].size, colors.shape[1]
    reach = jnp.max(jnp.abs(around), axis=-1)[:, None]
    beside, below = jnp.moveaxis(jnp.abs(border) <= reach, -1, 0)
    here, right, under, across = jnp.moveaxis(colors, -1, 0)
    mixed = beside & ((here != right) | (under != across))
    mixed |= below & ((here != under) | (right != across))
    colors, border, mixed = colors.reshape(number, 4), border.reshape(number, 2), mixed.ravel()
    middles = _draw_colors(colors, border, jnp.zeros((1, 2, 1)))[..., 0]
    found = jnp.dot(middles, jnp.sum(projection, axis=1), precision="highest")

    drawn = jnp.sum(mixed)
    (where,) = jnp.nonzero(mixed, size=number, fill_value=number)

    def some(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        done, found = carry
        cells = jax.lax.dynamic_slice_in_dim(where, done, _DRAWN_TOGETHER)
        one = jnp.minimum(cells, number - 1)  # of those that only fill up
        rgb = _draw_colors(colors[one], border[one], around[one // size])
        projected = jnp.einsum("ncp,cpf->nf", rgb, projection)
        return done + _DRAWN_TOGETHER, found.at[cells].set(projected, mode="drop")

    begin = jnp.zeros_like(drawn), found
    found = jax.lax.while_loop(lambda carry: carry[0] < drawn, some, begin)[1]
    return found.reshape(-1, size, projection.shape[-1])


def _draw_colors(colors: jax.Array, border: jax.Array, around: jax.Array) -> jax.Array:
    """`[N, 3, P]` of what `_read_colors` gave of N cells, at places around them `[N, 2, P]`."""
    right, below = jnp.moveaxis(around >= border[..., None], 1, 0)
    here, beside, under, across = jnp.moveaxis(colors[..., None], 1, 0)
    upper, lower = jnp.where(right, beside, here), jnp.where(right, across, under)
    color = jnp.where(below, lower, upper)[:, None]
    return (color >> _BYTES[:, None] & 255) / 127.5 - 1
