"""Mirrors drives together with their ground: twice the data, with left and right alike.

The world is mirrored across the diagonal from bottom left to top right, which exchanges x and y
about the center of the map. A mirror across an axis of the map would change the ground: rigid cells
are two triangles split along that diagonal, and would be split along the other. To a model this is
a left-right mirror, because models do not depend on position and heading. For the same reason
drives are not moved, turned or lifted: a model that is invariant by construction would learn
nothing from that.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from vertiwm_jax import geometry
from vertiwm_jax.learning.dataset import WheelSignals
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.terrain.map import MapError, TerrainMap


def with_mirrored(terrain: TerrainMap) -> TerrainMap:
    """The W worlds followed by their mirror images, worlds W to 2 W - 1.

    `MapError` unless maps and their class cells are square.
    """
    for field in ("elevation", "semantic"):
        rows, columns = getattr(terrain, field).shape[1:]
        if rows != columns:
            found = f"{rows} x {columns}"
            raise MapError("mirrored map", field, "a square map", found, "turn mirroring off")

    def both(raster: jax.Array) -> jax.Array:
        return jnp.concatenate([raster, jnp.swapaxes(raster[:, ::-1, ::-1], 1, 2)])

    boxes = terrain.obstacles
    exchanged = jnp.concatenate(
        [_across(terrain, boxes[..., :2]), boxes[..., 3:1:-1], boxes[..., 4:]], axis=-1
    )
    unused = jnp.all(boxes == 0, axis=-1, keepdims=True)
    return replace(
        terrain,
        elevation=both(terrain.elevation),
        semantic=both(terrain.semantic),
        friction=both(terrain.friction),
        obstacles=jnp.concatenate([boxes, jnp.where(unused, 0.0, exchanged)]),
    )


def mirror(windows: Windows, terrain: TerrainMap) -> Windows:
    """The mirror images of windows on the original worlds of `with_mirrored`'s `terrain`.

    Signals of the wheels are left out.
    """
    state, control = windows.state, windows.control
    roll, pitch, yaw = state[..., 3], state[..., 4], state[..., 5]
    position = [_across(terrain, state[..., :2]), state[..., 2:3]]
    rpy = jnp.stack([-roll, pitch, geometry.wrap(jnp.pi / 2 - yaw)], axis=-1)
    velocity = state[..., 6:] * jnp.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    return replace(
        windows,
        state=jnp.concatenate([*position, rpy, velocity], axis=-1),
        control=control * jnp.array([1.0, -1.0]),
        world=windows.world + terrain.worlds // 2,
        wheels=WheelSignals(),
    )


def mirror_some(key: jax.Array, windows: Windows, terrain: TerrainMap) -> Windows:
    """Mirrors each window with probability 1/2, and leaves out signals of the wheels."""
    chosen = jax.random.bernoulli(key, shape=windows.world.shape)

    def choose(image: jax.Array, original: jax.Array) -> jax.Array:
        return jnp.where(chosen.reshape(-1, *(1,) * (original.ndim - 1)), image, original)

    image = mirror(windows, terrain)
    return jax.tree.map(choose, image, replace(windows, wheels=image.wheels))


def _across(terrain: TerrainMap, xy: jax.Array) -> jax.Array:
    """Points `[..., 2]` with x and y exchanged about the center of the map."""
    half = 0.5 * (terrain.elevation.shape[1] - 1) * terrain.resolution
    center = terrain.origin + half * jnp.array([1.0, -1.0])
    return center + (xy - center)[..., ::-1]
