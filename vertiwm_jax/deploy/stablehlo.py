"""JAX functions as StableHLO files, which `jax.export.deserialize` reads without this package."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from vertiwm_jax.env import observation
from vertiwm_jax.env.route import Routes
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.perception.features import Encoders
from vertiwm_jax.perception.perceive import embed
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain.map import TerrainMap

PLATFORMS = ("cpu", "cuda")


def policy(act: Callable[[jax.Array], jax.Array], size: int, standing: Sequence[float]) -> bytes:
    """Exports `act`: `[B, size]` float32 observations to `[B, 2]` actions, for any B.

    standing: the action of standing still, which it gives where an observation is not finite.
    """
    (batch,) = export.symbolic_shape("batch")

    def stopping(seen: jax.Array) -> jax.Array:
        finite = jnp.isfinite(seen).all(axis=1, keepdims=True)
        return jnp.where(finite, act(seen), jnp.array(standing, jnp.float32))

    return _serialized(stopping, _floats(batch, size))


def route(config: NavigationConfig, vehicle: Vehicle) -> bytes:
    """Exports the route to a goal on maps of any size, with the arguments of `_route`."""
    return _serialized(partial(_route, config, vehicle), *_map_arrays(), _floats(3))


def observe(config: NavigationConfig, vehicle: Vehicle, encoders: Encoders | None) -> bytes:
    """Exports `observation.observe` on maps of any size, with the arguments of `_observe`.

    encoders: by which it sees the ground, if it ends with that.
    """
    way = _floats(config.route.cells, config.route.cells)
    seen = way, _floats(12), _floats(3), _floats(2), _floats(2)
    return _serialized(partial(_observe, config, vehicle, encoders), *_map_arrays(), *seen)


def _route(config: NavigationConfig, vehicle: Vehicle, *arguments: jax.Array) -> jax.Array:
    """`[n, n]` cost to go, m; the arguments are those of `_terrain`, then the goal `[3]`, m."""
    *arrays, goal = arguments
    return config.route_to(_terrain(*arrays), vehicle, goal[:2]).cost[0]


def _observe(
    config: NavigationConfig, driven: Vehicle, encoders: Encoders | None, *arguments: jax.Array
) -> jax.Array:
    """`[O]` the observation; the arguments are those of `_terrain`, then five more.

    route: `[n, n]`, of `_route`. state: `[12]`, as `VehicleState.vector`. goal: `[3]` m. action:
    `[2]`, the last one. waiting: `[2]` s, for how long the vehicle has been slower than 0.3 m/s,
    and been told to drive backwards, without a break.
    """
    *arrays, cost, state, goal, action, waiting = arguments
    terrain, vehicle = _terrain(*arrays), VehicleState.from_vector(state)
    route = Routes(cost[None], jnp.int32(0))
    latents = embed(encoders, terrain, vehicle) if encoders else None
    seen = vehicle, goal, route, action, waiting, latents
    return observation.observe(config.observed, terrain, driven, *seen)


def _terrain(*arrays: jax.Array) -> TerrainMap:
    """A map of one world with the standard classes.

    arrays: elevation, semantic, friction, obstacles, origin and resolution, as `TerrainMap`
        describes them.
    """
    *rasters, origin, resolution = arrays
    names = "elevation", "semantic", "friction", "obstacles"
    changes = {name: raster[None] for name, raster in zip(names, rasters, strict=True)}
    with jax.ensure_compile_time_eval():  # Checks look at its values.
        flat = TerrainMap.from_array(np.zeros((2, 2)))
    return replace(flat, **changes, origin=origin, resolution=resolution)


def _map_arrays() -> tuple[jax.ShapeDtypeStruct, ...]:
    """The arguments of `_terrain`, for maps of any size."""
    *vertices, r, c, boxes = export.symbolic_shape("R, C, r, c, N")
    classes = jax.ShapeDtypeStruct((r, c), jnp.uint8)
    return _floats(*vertices), classes, _floats(r, c), _floats(boxes, 5), _floats(2), _floats()


def _floats(*shape: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def _serialized(function: Callable[..., jax.Array], *arguments: jax.ShapeDtypeStruct) -> bytes:
    return bytes(export.export(jax.jit(function), platforms=PLATFORMS)(*arguments).serialize())
