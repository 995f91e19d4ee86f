"""Corrects a map by measurements while driving. Only arrays change, so nothing compiles again."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from vertiwm_jax.terrain.map import TerrainMap


def heights(terrain: TerrainMap, corner: jax.Array, measured: jax.Array) -> TerrainMap:
    """The map with measured heights in its selected world.

    measured: `[h, w]` m, on the vertices south and east of the one nearest to `[2]` corner, p_world
    in m. NaN, and values off the map, change nothing. Other shapes raise `ValueError`.
    """
    _check_shapes(corner, measured=measured)
    column, row = _offset(terrain, corner) / terrain.resolution
    place = jnp.round(row), jnp.round(column)
    known = jnp.isfinite(measured)
    return replace(terrain, elevation=_pasted(terrain, terrain.elevation, place, measured, known))


def classes(
    terrain: TerrainMap, corner: jax.Array, semantic: jax.Array, friction: jax.Array
) -> TerrainMap:
    """The map with measured ground classes in its selected world.

    semantic: `[h, w]` class ids, on the cells south and east of the one in which `[2]` corner lies,
    p_world in m. friction: `[h, w]` friction coefficients; not used on soil. Unknown ids,
    and values off the map, change nothing. Other shapes raise `ValueError`.
    """
    _check_shapes(corner, semantic=semantic, friction=friction)
    _, rows, columns = terrain.elevation.shape
    _, cell_rows, cell_columns = terrain.semantic.shape
    column, row = _offset(terrain, corner) / terrain.resolution
    place = (
        jnp.floor(row * cell_rows / (rows - 1)),
        jnp.floor(column * cell_columns / (columns - 1)),
    )
    known = (semantic >= 0) & (semantic < len(terrain.class_names))
    soft = terrain.deformable[jnp.where(known, semantic, 0)]
    friction = jnp.where(soft, 0.0, friction)
    return replace(
        terrain,
        semantic=_pasted(terrain, terrain.semantic, place, semantic, known),
        friction=_pasted(terrain, terrain.friction, place, friction, known),
    )


def _offset(terrain: TerrainMap, corner: jax.Array) -> jax.Array:
    """m to the east and to the south of the map's north-western vertex `[2]`."""
    return (corner - terrain.origin) * jnp.array([1.0, -1.0])


def _pasted(
    terrain: TerrainMap,
    layer: jax.Array,
    place: tuple[jax.Array, jax.Array],
    patch: jax.Array,
    known: jax.Array,
) -> jax.Array:
    """The layer `[W, R, C]` with the known values of a patch at the given first row and column."""
    row, column = (x.astype(jnp.int32) for x in place)
    i = row + jnp.arange(patch.shape[0])[:, None]
    j = column + jnp.arange(patch.shape[1])
    # Negative indices would count from the end; those past it are dropped.
    used = known & (i >= 0) & (j >= 0)
    i = jnp.where(used, i, layer.shape[1])
    return layer.at[terrain.world, i, j].set(patch.astype(layer.dtype), mode="drop")


def _check_shapes(corner: jax.Array, **patches: jax.Array) -> None:
    if jnp.shape(corner) != (2,):
        raise ValueError(f"corner: expected shape (2,), x and y in m, found {jnp.shape(corner)}")
    first = next(iter(patches.values()))
    for name, patch in patches.items():
        if jnp.ndim(patch) != 2 or jnp.shape(patch) != jnp.shape(first):
            expected = "two axes" if patch is first else f"shape {jnp.shape(first)} as of semantic"
            raise ValueError(f"{name}: expected {expected}, found shape {jnp.shape(patch)}")
