"""Functions of JAX as files: StableHLO, which `jax.export.deserialize` reads with JAX alone."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import export

from vertiwm_jax.env import observation
from vertiwm_jax.env.chassis import Chassis
from vertiwm_jax.env.observation import OBSERVATION_SIZE
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain.classes import STANDARD
from vertiwm_jax.terrain.map import ELEVATION_RANGE, TerrainMap

PLATFORMS = ("cpu", "cuda")


def policy(act: Callable[[jax.Array], jax.Array]) -> bytes:
    """`act`, `[B, O]` float32 observations to `[B, 2]` actions, for any B."""
    (batch,) = export.symbolic_shape("batch")
    return _serialised(act, _floats(batch, OBSERVATION_SIZE))


def observe(chassis: Chassis) -> bytes:
    """`observation.observe` of map arrays, for maps of any size; the arguments of `_observe`."""
    rows, columns, cell_rows, cell_columns, boxes = export.symbolic_shape(
        "rows, columns, cell_rows, cell_columns, boxes"
    )
    return _serialised(
        partial(_observe, chassis),
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
    return observation.observe(terrain, chassis, VehicleState.from_vector(state), goal, action)


def _floats(*shape: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def _serialised(function: Callable[..., jax.Array], *arguments: jax.ShapeDtypeStruct) -> bytes:
    return bytes(export.export(jax.jit(function), platforms=PLATFORMS)(*arguments).serialize())
