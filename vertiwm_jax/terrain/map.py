"""The terrain map: what the ground is, everywhere, for one world or many stacked ones."""

from typing import Self

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.terrain.soil import Soil


@struct.dataclass
class TerrainMap:
    """W worlds of equal size, of which one is selected.

    Elevation lives on vertices: vertex (row r, column c) is x = origin_x + c resolution,
    y = origin_y - r resolution (row 0 at the largest y). Classes live on cells that tile the
    same extent: cell (i, j) of an `[r, c]` raster covers extent_x / c by extent_y / r metres.

    elevation: `[W, R, C]` m.
    semantic: `[W, r, c]` uint8 class ids.
    friction: `[W, r, c]` friction coefficient of rigid ground; 0 where the ground is soil.
    obstacles: `[W, N, 5]` centre x, y, size x, size y, height above ground, m; unused rows are 0.
    origin: `[2]` world x, y of vertex (0, 0), m.
    resolution: `[]` m between vertices.
    elevation_range: `[2]` m, mapped to [-1, 1] in elevation patches.
    class_rgb: `[K, 3]` uint8 palette.
    deformable: `[K]` bool, whether a class is soil.
    soils: leaves `[K]`; rows of rigid classes are never used but finite.
    world: `[]` int32, the selected world.
    class_names: K names, static.
    """

    elevation: jax.Array
    semantic: jax.Array
    friction: jax.Array
    obstacles: jax.Array
    origin: jax.Array
    resolution: jax.Array
    elevation_range: jax.Array
    class_rgb: jax.Array
    deformable: jax.Array
    soils: Soil
    world: jax.Array
    class_names: tuple[str, ...] = struct.field(pytree_node=False)

    @property
    def worlds(self) -> int:
        """How many worlds are stacked."""
        return self.elevation.shape[0]

    def select(self, world: jax.Array) -> Self:
        """The map with world `[]` selected. Under `vmap` only the index is batched: no copy."""
        return self.replace(world=jnp.asarray(world, jnp.int32))
