"""Vehicle-aligned patches of the map, in the order in which encoders read them.

That is cell by cell of 8 x 8 pixels. `cells` has what linear maps make of these, which takes a CPU
a fraction of the time.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.state import CELL_PIXELS, STEP_SECONDS, Patches
from vertiwm_jax.terrain import grid
from vertiwm_jax.terrain.map import TerrainMap

PATCH_PIXELS = 128
PATCH_METRES = 12.8
RELIEF_METRES = 4.0
"""Height above or below the vehicle that is 1 in patches relative to it."""
PIXEL_METRES = PATCH_METRES / PATCH_PIXELS

_CELLS = PATCH_PIXELS // CELL_PIXELS


def _square(number: int, metres: float) -> np.ndarray:
    """`[2, number**2]` m ahead and to the left of the middle of a square, from its front left."""
    offset = ((number - 1) / 2 - np.arange(number)) * metres
    return np.stack(np.meshgrid(offset, offset, indexing="ij")).reshape(2, -1).astype(np.float32)


CELLS_OF_PATCH = _square(_CELLS, CELL_PIXELS * PIXEL_METRES)
"""`[2, 256]` m from the vehicle to the middles of cells, row by row."""
_PIXELS_OF_CELL = _square(CELL_PIXELS, PIXEL_METRES)


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
    level, relief = scale(terrain, position, config)
    elevation, rgb = pixels(terrain, *places(terrain, position, yaw), level, relief, config)
    return Patches(_image(elevation[:, None])[..., 0], _image(rgb))


def scale(
    terrain: TerrainMap, position: jax.Array, config: PatchConfig
) -> tuple[jax.Array, jax.Array | float]:
    """The height that is 0 in a patch, and how far above it 1 is, m."""
    if config.reference == "map":
        low, high = terrain.elevation_range
        return (low + high) / 2, (high - low) / 2
    return position[2], RELIEF_METRES


def places(
    terrain: TerrainMap, position: jax.Array, yaw: jax.Array, cells: np.ndarray = CELLS_OF_PATCH
) -> tuple[jax.Array, jax.Array]:
    """Fractional columns and rows of the map.

    `[2, N]` of the middles of a patch's cells, and from there `[2, 64]` to the pixels of each.
    """
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    x, y = position[0] - terrain.origin[0], terrain.origin[1] - position[1]
    turn = jnp.array([[cos, -sin], [-sin, -cos]]) / terrain.resolution
    origin = jnp.stack([x, y])[:, None] / terrain.resolution
    # Matmuls in full precision: anything else would be fused, sine and cosine for every pixel.
    middles = jnp.dot(turn, cells, precision="highest") + origin
    around = jnp.dot(turn, _PIXELS_OF_CELL, precision="highest")
    lost = jnp.isnan(middles[:, :1])
    return jnp.where(lost, 0.0, middles), jnp.where(lost, 0.0, around)


def pixels(
    terrain: TerrainMap,
    middles: jax.Array,
    around: jax.Array,
    level: jax.Array,
    relief: jax.Array | float,
    config: PatchConfig,
) -> tuple[jax.Array, jax.Array]:
    """Elevations `[256, 64]` and colours `[256, 3, 64]` of all pixels, at `places`, by `scale`."""
    column, row = grid.on_map(terrain, *(middles[:, :, None] + around[:, None]))
    read = grid.nearest if config.interpolation == "nearest" else grid.bilinear
    elevation = jnp.clip((read(terrain, row, column) - level) / relief, -1, 1)
    semantic = grid.classes(terrain, row, column, grid.cell_index(terrain, row, column))
    palette = terrain.class_rgb / 127.5 - 1
    return elevation, jnp.stack([grid.gather(c, semantic) for c in palette.T], axis=1)


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


def _image(cells: jax.Array) -> jax.Array:
    """Pixels `[256, C, 64]`, cell by cell, to the image `[128, 128, C]`."""
    channels = cells.shape[1]
    squares = cells.reshape(_CELLS, _CELLS, channels, CELL_PIXELS, CELL_PIXELS)
    return squares.transpose(0, 3, 1, 4, 2).reshape(PATCH_PIXELS, PATCH_PIXELS, channels)
