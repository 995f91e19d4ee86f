"""Reads the rasters of a map at coordinates.

Every gather is a flat index into the stacked worlds, clipped first and then promised in bounds,
so that a batch of vehicles on different worlds is one gather and copies no map. Outside the map
the ground continues level from its edge; a NaN coordinate reads the first row or column. Where
a map is observed in part, unknown ground is as `ObservedMap` assumes.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from vertiwm_jax.terrain.map import ObservedMap, TerrainMap


def on_map(terrain: TerrainMap, column: jax.Array, row: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Fractional (column, row), or those of the nearest edge; NaN becomes 0."""
    _, rows, columns = terrain.elevation.shape
    # `where` and not `clip`: NaN becomes 0, and its gradient too.
    column = jnp.minimum(jnp.where(column > 0, column, 0.0), columns - 1.0)
    row = jnp.minimum(jnp.where(row > 0, row, 0.0), rows - 1.0)
    return column, row


def flat_index(
    terrain: TerrainMap, rows: int, columns: int, row: jax.Array, column: jax.Array
) -> jax.Array:
    """Where rows and columns of the selected world lie in a stack of rasters, flat."""
    return (terrain.world * rows + row) * columns + column


def gather(table: jax.Array, index: jax.Array) -> jax.Array:
    """Elements of a table at flat indices, which are promised to be in bounds."""
    flat = table.reshape(-1)
    return flat.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def cell_index(terrain: TerrainMap, row: jax.Array, column: jax.Array) -> jax.Array:
    """The class cell that contains fractional vertex coordinates on the map."""
    _, cell_rows, cell_columns = terrain.semantic.shape
    i, j = _cell(terrain, cell_rows, cell_columns, row, column)
    return flat_index(terrain, cell_rows, cell_columns, i, j)


def _cell(
    terrain: TerrainMap, cell_rows: int, cell_columns: int, row: jax.Array, column: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Which of the cells that tile the map contains fractional vertex coordinates on it."""
    _, rows, columns = terrain.elevation.shape
    i = jnp.minimum((row * (cell_rows / (rows - 1))).astype(jnp.int32), cell_rows - 1)
    j = jnp.minimum((column * (cell_columns / (columns - 1))).astype(jnp.int32), cell_columns - 1)
    return i, j


def known(terrain: TerrainMap, known: jax.Array, row: jax.Array, column: jax.Array) -> jax.Array:
    """Elements of `ObservedMap.known` at fractional vertex coordinates on the map."""
    cell_rows, cell_columns = known.shape
    i, j = _cell(terrain, cell_rows, cell_columns, row, column)
    return gather(known, i * cell_columns + j)


def as_observed(
    terrain: TerrainMap,
    row: jax.Array,
    column: jax.Array,
    values: jax.Array,
    assumed: Callable[[ObservedMap], jax.Array],
) -> jax.Array:
    """Values of the map at fractional vertex coordinates; where it is unknown, what is assumed."""
    observed = terrain.observed
    if observed is None:
        return values
    return jnp.where(known(terrain, observed.known, row, column), values, assumed(observed))


def classes(terrain: TerrainMap, row: jax.Array, column: jax.Array, cell: jax.Array) -> jax.Array:
    """int32 class ids at fractional vertex coordinates on the map, which lie in the cells."""
    semantic = gather(terrain.semantic, cell).astype(jnp.int32)
    return as_observed(terrain, row, column, semantic, lambda observed: observed.semantic)


def _vertices(
    terrain: TerrainMap, row: jax.Array, column: jax.Array, index: jax.Array
) -> jax.Array:
    """Heights of the vertices in the rows and columns, at the index, m."""

    def assumed(observed: ObservedMap) -> jax.Array:
        x = terrain.origin[0] + column * terrain.resolution
        y = terrain.origin[1] - row * terrain.resolution
        return observed.plane[0] + observed.plane[1] * x + observed.plane[2] * y

    heights, observed = gather(terrain.elevation, index), terrain.observed
    if observed is not None and observed.noise is not None:
        error = 2 * uniform(index.astype(jnp.uint32), observed.seed) - 1
        heights += observed.noise * jnp.sqrt(3.0) * error
    return as_observed(terrain, row, column, heights, assumed)


def uniform(index: jax.Array, seed: jax.Array) -> jax.Array:
    """Numbers in [0, 1), one for each uint32 index `[...]`: the finalizer of MurmurHash3.

    Where single elements of a large field of random numbers are read, it makes only these.
    """
    x = index * jnp.uint32(0x9E3779B9) + seed * jnp.uint32(0x85EBCA6B)
    x = (x ^ (x >> 16)) * jnp.uint32(0x85EBCA6B)
    x = (x ^ (x >> 13)) * jnp.uint32(0xC2B2AE35)
    return ((x ^ (x >> 16)) >> 8).astype(jnp.float32) / 2**24


def bilinear(terrain: TerrainMap, row: jax.Array, column: jax.Array) -> jax.Array:
    """Heights at fractional coordinates on the map, bilinear between vertices, m."""
    bottom_left, along, up, twist, fx, fy = corners(terrain, row, column)
    return bottom_left + fx * along + fy * up + twist * fx * fy


def corners(terrain: TerrainMap, row: jax.Array, column: jax.Array) -> tuple[jax.Array, ...]:
    """The vertex cell around a point: its corner, edges, twist, and the point's place in it.

    The bilinear height is bottom_left + fx along + fy up + fx fy twist.
    """
    _, rows, columns = terrain.elevation.shape
    r = jnp.minimum(row.astype(jnp.int32), rows - 2)
    c = jnp.minimum(column.astype(jnp.int32), columns - 2)
    fx, fy = column - c, 1.0 - (row - r)
    top = flat_index(terrain, rows, columns, r, c)
    bottom = top + columns
    top_left = _vertices(terrain, r, c, top)
    top_right = _vertices(terrain, r, c + 1, top + 1)
    bottom_left = _vertices(terrain, r + 1, c, bottom)
    bottom_right = _vertices(terrain, r + 1, c + 1, bottom + 1)
    along, up = bottom_right - bottom_left, top_left - bottom_left
    return bottom_left, along, up, top_right - top_left - along, fx, fy
