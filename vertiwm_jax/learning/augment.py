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
import numpy as np

from vertiwm_jax import geometry
from vertiwm_jax.learning.dataset import Array, WheelSignals
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.terrain.map import MapError, TerrainMap

_OTHER_SIDE = np.array([1, 0, 3, 2])
_EXCHANGED = np.array([1, 0, 2])


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
    """The mirror images of windows on the original worlds of `with_mirrored`'s `terrain`."""
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
        wheels=_mirror_wheels(windows.wheels),
    )


def mirror_some(key: jax.Array, windows: Windows, terrain: TerrainMap) -> Windows:
    """Mirrors each window with probability 1/2."""
    chosen = jax.random.bernoulli(key, shape=windows.world.shape)

    def choose(image: jax.Array, original: jax.Array) -> jax.Array:
        return jnp.where(chosen.reshape(-1, *(1,) * (original.ndim - 1)), image, original)

    return jax.tree.map(choose, mirror(windows, terrain), windows)


def _across(terrain: TerrainMap, xy: jax.Array) -> jax.Array:
    """Points `[..., 2]` with x and y exchanged about the center of the map."""
    half = 0.5 * (terrain.elevation.shape[1] - 1) * terrain.resolution
    centre = terrain.origin + half * jnp.array([1.0, -1.0])
    return centre + (xy - centre)[..., ::-1]


def _mirror_wheels(recorded: WheelSignals) -> WheelSignals:
    def other_side(wheels: Array | None) -> Array | None:
        return None if wheels is None else wheels[..., _OTHER_SIDE]

    force, chassis, steer = recorded.wheel_force, recorded.chassis_force, recorded.steer_angle
    return WheelSignals(
        wheel_omega=other_side(recorded.wheel_omega),
        wheel_sinkage=other_side(recorded.wheel_sinkage),
        wheel_force=None if force is None else force[..., _OTHER_SIDE, :][..., _EXCHANGED],
        chassis_force=None if chassis is None else chassis[..., _EXCHANGED],
        steer_angle=None if steer is None else -steer[..., ::-1],
    )
