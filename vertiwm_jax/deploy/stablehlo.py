"""Functions of JAX as files: StableHLO, which `jax.export.deserialize` reads with JAX alone."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import export

from vertiwm_jax.env import observation
from vertiwm_jax.env.chassis import Chassis
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain.classes import STANDARD
from vertiwm_jax.terrain.map import ELEVATION_RANGE, TerrainMap
from vertiwm_jax.world_model.perception import Eyes

PLATFORMS = ("cpu", "cuda")


def policy(act: Callable[[jax.Array], jax.Array], size: int) -> bytes:
    """`act`, `[B, size]` float32 observations to `[B, 2]` actions, for any B."""
    (batch,) = export.symbolic_shape("batch")
    return _serialised(act, _floats(batch, size))


def observe(chassis: Chassis, eyes: Eyes | None) -> bytes:
    """`observation.observe` of map arrays, for maps of any size; the arguments of `_observe`.

    With eyes, the observation ends with what they see.
    """
    rows, columns, cell_rows, cell_columns, boxes = export.symbolic_shape(
        "rows, columns, cell_rows, cell_columns, boxes"
    )
    return _serialised(
        partial(_observe, chassis, eyes),
        _floats(rows, columns),
        jax.ShapeDtypeStruct((cell_rows, cell_columns), jnp.uint8),
        _floats(cell_rows, cell_columns),
        _floats(boxes, 5),
        _floats(2),
        _floats(),
        _floats(12),
        _floats(3),
        _floats(2),
    )


def _observe(
    chassis: Chassis,
    eyes: Eyes | None,
    elevation: jax.Array,
    semantic: jax.Array,
    friction: jax.Array,
    obstacles: jax.Array,
    origin: jax.Array,
    resolution: jax.Array,
    state: jax.Array,
    goal: jax.Array,
    action: jax.Array,
) -> jax.Array:
    """`[O]` seen on one world of the standard classes, whose arrays `TerrainMap` describes.

    state: `[12]`, as `VehicleState.vector`; goal: `[3]` m; action: `[2]` the last one.
    """
    terrain = TerrainMap(
        elevation=elevation[None],
        semantic=semantic[None],
        friction=friction[None],
        obstacles=obstacles[None],
        origin=origin,
        resolution=resolution,
        elevation_range=jnp.array(ELEVATION_RANGE),
        class_rgb=jnp.asarray(STANDARD.rgb),
        deformable=jnp.asarray(STANDARD.deformable),
        soils=STANDARD.stacked_soils(),
        world=jnp.int32(0),
        class_names=STANDARD.names,
    )
    vehicle = VehicleState.from_vector(state)
    seen = observation.observe(terrain, chassis, vehicle, goal, action)
    return observation.with_embedding(seen, eyes(terrain, vehicle).latent) if eyes else seen


def _floats(*shape: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def _serialised(function: Callable[..., jax.Array], *arguments: jax.ShapeDtypeStruct) -> bytes:
    return bytes(export.export(jax.jit(function), platforms=PLATFORMS)(*arguments).serialize())
