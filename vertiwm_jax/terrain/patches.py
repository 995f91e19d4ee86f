"""The query Q of the map: patches of the ground about a vehicle, as encoders read them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.config import ConfigError
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain import _raster
from vertiwm_jax.terrain.map import TerrainMap

PATCH_PIXELS = 128
PATCH_METERS = 12.8
CELL_PIXELS = 8
"""Side of the squares of pixels that encoders read one by one; a patch has 16 x 16 of them."""
RELIEF_METERS = 4.0
"""Height above or below the vehicle that is 1 in a patch."""
PIXEL_METERS = PATCH_METERS / PATCH_PIXELS

_CELLS = PATCH_PIXELS // CELL_PIXELS


@struct.dataclass
class Patches:
    """Vehicle-aligned observations of the ground, m_t of the paper, in [-1, 1].

    elevation: `[..., 128, 128]`; row 0 is farthest ahead, column 0 farthest left.
    rgb: `[..., 128, 128, 3]` semantic colors, same pixels.
    """

    elevation: jax.Array
    rgb: jax.Array


def _square(number: int, meters: float) -> np.ndarray:
    """`[2, number**2]` m ahead and to the left of the middle of a square, from its front left."""
    offset = ((number - 1) / 2 - np.arange(number)) * meters
    return np.stack(np.meshgrid(offset, offset, indexing="ij")).reshape(2, -1).astype(np.float32)


CELLS_OF_PATCH = _square(_CELLS, CELL_PIXELS * PIXEL_METERS)
"""`[2, 256]` m from the vehicle to the middles of cells, row by row."""
_PIXELS_OF_CELL = _square(CELL_PIXELS, PIXEL_METERS)


@partial(jax.jit, inline=True)
def query(terrain: TerrainMap, position: jax.Array, yaw: jax.Array) -> Patches:
    """What one vehicle at `[3]` p_world (m) and `[]` yaw (rad) sees.

    Pixels are 0.1 m, row 0 farthest ahead, column 0 farthest left, the vehicle midway between
    the four central ones. Elevations are bilinear between vertices and count from the body origin,
    over `RELIEF_METERS`, so they do not change when map and vehicle are lifted together. The paper
    reads the nearest vertex and scales by the range of the whole map. Each pixel has the color of
    its class. Pixels off the map take the nearest edge. A NaN x, y or yaw sees vertex (0, 0) in
    every pixel; a NaN height gives NaN elevations. No gradient flows to the pose. Batch with
    `vmap`, selecting each vehicle's world inside.
    """
    position, yaw = jax.lax.stop_gradient((position, yaw))
    elevation, rgb = pixels(terrain, *places(terrain, position, yaw), position[2])
    return Patches(_image(elevation[:, None])[..., 0], _image(rgb))


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
    terrain: TerrainMap, middles: jax.Array, around: jax.Array, height: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Elevations `[256, 64]` above a height `[]`, m, and colors `[256, 3, 64]`, at `places`."""
    column, row = _raster.on_map(terrain, *(middles[:, :, None] + around[:, None]))
    ground = _raster.bilinear(terrain, row, column)
    ruts = pressed(terrain, middles, around)
    ground = ground if ruts is None else ground - ruts
    elevation = jnp.clip((ground - height) / RELIEF_METERS, -1, 1)
    semantic = _raster.classes(terrain, row, column, _raster.cell_index(terrain, row, column))
    palette = terrain.class_rgb / 127.5 - 1
    return elevation, jnp.stack([_raster.gather(c, semantic) for c in palette.T], axis=1)


def pressed(terrain: TerrainMap, middles: jax.Array, around: jax.Array) -> jax.Array | None:
    """Depth of ruts `[256, 64]`, m, at `places`; None if the map has none."""
    if terrain.ruts is None:
        return None
    column, row = middles[:, :, None] + around[:, None]
    x = terrain.origin[0] + terrain.resolution * column
    return terrain.ruts.at(x, terrain.origin[1] - terrain.resolution * row)


def footprint_covered(wheel_reach: float, top_speed: float) -> None:
    """Raises `ConfigError` unless a patch covers the wheels of the next pose (Sec. III-A).

    wheel_reach: m from the body origin to the farthest ground a wheel can touch.
    top_speed: m/s, the largest in any direction.
    """
    needed, covered = wheel_reach + top_speed * STEP_SECONDS, PATCH_METERS / 2
    if not needed <= covered:
        fastest = (covered - wheel_reach) / STEP_SECONDS
        raise ConfigError(
            f"patch: expected {PATCH_METERS} m to cover the wheels of the next pose, found a reach "
            f"of {wheel_reach:g} m + {top_speed:g} m/s x {STEP_SECONDS:g} s = {needed:g} m "
            f"> {covered:g} m; keep the top speed below {fastest:g} m/s"
        )


def _image(cells: jax.Array) -> jax.Array:
    """Pixels `[256, C, 64]`, cell by cell, to the image `[128, 128, C]`."""
    channels = cells.shape[1]
    squares = cells.reshape(_CELLS, _CELLS, channels, CELL_PIXELS, CELL_PIXELS)
    return squares.transpose(0, 3, 1, 4, 2).reshape(PATCH_PIXELS, PATCH_PIXELS, channels)
