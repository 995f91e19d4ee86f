"""Learning to see the ground of drives: terrain autoencoders, and the soil predictor."""

from dataclasses import dataclass
from typing import Any, Self, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax import parallel
from vertiwm_jax.config import Count, NotNegative, settings
from vertiwm_jax.dynamics import Params
from vertiwm_jax.learning.dataset import Drives
from vertiwm_jax.networks.encoder import TerrainAutoencoder, TerrainEncoder
from vertiwm_jax.networks.soil_predictor import SoilPredictor
from vertiwm_jax.terrain import patches, query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.patches import PATCH_PIXELS, RELIEF_METERS, Patches
from vertiwm_jax.terrain.soil import BOUNDS, Soil, to_unit

_ELEVATION, _SEMANTIC = TerrainAutoencoder(1), TerrainAutoencoder(3)
_NETWORKS = {"elevation": _ELEVATION, "semantic": _SEMANTIC}


@settings
class AutoencoderConfig:
    """Which patches a pair of autoencoders is trained on."""

    batch: Count = 16
    """Patches in a batch."""
    offset: NotNegative = 20.0
    """How far from a recorded place patches are taken, m, along x and y; their yaw is any."""
    validation: Count = 256
    """Patches to validate on, at recorded poses."""


@struct.dataclass
class Places:
    """P recorded places of vehicles. position: `[P, 3]` m; yaw: `[P]` rad; world: `[P]`."""

    position: jax.Array
    yaw: jax.Array
    world: jax.Array

    @classmethod
    def of(cls, drives: Drives) -> Self:
        """All valid ones."""
        valid = np.arange(drives.state.shape[1]) <= np.asarray(drives.length)[:, None]
        state = np.asarray(drives.state)[valid]
        world = np.broadcast_to(np.asarray(drives.world)[:, None], valid.shape)[valid]
        return cls(*map(jnp.asarray, (state[:, :3], state[:, 5], world)))


@struct.dataclass
class PatchData:
    """Places to train on and to validate on, with their ground."""

    places: Places
    terrain: TerrainMap
    validation: Places
    validation_terrain: TerrainMap

    @classmethod
    def of(
        cls,
        config: AutoencoderConfig,
        training: tuple[Drives, TerrainMap],
        validation: tuple[Drives, TerrainMap],
    ) -> Self:
        """All places of the training drives, and `config.validation` of the validation drives."""
        held_out = Places.of(validation[0])
        rows = np.linspace(0, len(held_out.yaw) - 1, config.validation).astype(int)
        some = jax.tree.map(lambda x: x[rows], held_out)
        return cls(Places.of(training[0]), training[1], some, validation[1])


@dataclass(frozen=True)
class AutoencoderProblem:
    """A `fitting.Problem`: the squared error of reconstructed elevations and colors."""

    config: AutoencoderConfig

    def init_params(self, key: jax.Array) -> Params:
        """Untrained networks `elevation` and `semantic`."""
        keys = dict(zip(_NETWORKS, jax.random.split(key), strict=True))
        pixels = PATCH_PIXELS, PATCH_PIXELS
        return {
            name: network.init(keys[name], jnp.zeros((*pixels, network.channels)))
            for name, network in _NETWORKS.items()
        }

    def loss(self, params: Params, data: PatchData, key: jax.Array) -> jax.Array:
        """The mean squared error `[]` of both, on patches near recorded places."""
        errors = parallel.vmap(_errors, (None, None, 0))
        elevation, color, _ = errors(params, data.terrain, near(data, key, self.config))
        return jnp.mean(elevation + color)

    def validate(self, params: Params, data: PatchData) -> dict[str, jax.Array]:
        """Errors of reconstruction at recorded poses; `error` is the loss there.

        elevation_rms: m, of heights as the patch has them, within its limits. colour_accuracy:
        share of the pixels whose reconstructed color is nearest to that of their own class.
        """
        errors = parallel.vmap(_errors, (None, None, 0), self.config.batch)
        found = errors(params, data.validation_terrain, data.validation)
        elevation, color, accuracy = map(jnp.mean, found)
        return {
            "elevation_rms": RELIEF_METERS * jnp.sqrt(elevation),
            "colour_accuracy": accuracy,
            "error": elevation + color,
        }


@dataclass(frozen=True)
class SoilProblem:
    """A `fitting.Problem`: the soil under the vehicle, from what the ground around it looks like.

    The soils of the map are the targets; places on rigid ground do not count. Parameters are
    `semantic`, the frozen encoder of colors, and `soil`.
    """

    config: AutoencoderConfig

    def loss(self, params: Params, data: PatchData, key: jax.Array) -> jax.Array:
        """Mean squared error `[]` of the six parameters, each as its share of `BOUNDS`."""
        places = near(data, key, self.config)
        errors = parallel.vmap(self._error, (None, None, 0))
        error, counts = errors(params, data.terrain, places)
        return jnp.sum(jnp.mean(error**2, axis=-1)) / jnp.maximum(jnp.sum(counts), 1.0)

    def validate(self, params: Params, data: PatchData) -> dict[str, jax.Array]:
        """Root mean square errors at recorded places on soil, as shares of `BOUNDS`."""
        errors = parallel.vmap(self._error, (None, None, 0), self.config.batch)
        error, counts = errors(params, data.validation_terrain, data.validation)
        square = jnp.sum(error**2, axis=0) / jnp.maximum(jnp.sum(counts), 1.0)
        each = {f"error_{name}": jnp.sqrt(x) for name, x in zip(BOUNDS, square, strict=True)}
        return {**each, "error": jnp.sqrt(jnp.mean(square))}

    def _error(
        self, params: Params, terrain: TerrainMap, place: Places
    ) -> tuple[jax.Array, jax.Array]:
        """`[6]` differences at one place, zero on rigid ground, and 1 on soil."""
        world = terrain.select(place.world)
        seen = patches.query(world, place.position, place.yaw)
        encoder = jax.lax.stop_gradient(params["semantic"])
        latent = cast(jax.Array, TerrainEncoder(3).apply(encoder, seen.rgb))
        predicted = cast(Soil, SoilPredictor().apply(params["soil"], latent))
        kind = query.surface(world, place.position[:2]).semantic
        true = query.soil(world, kind)
        soft = terrain.deformable[kind].astype(jnp.float32)
        return soft * (to_unit(predicted) - to_unit(true)), soft


def _errors(params: Params, terrain: TerrainMap, place: Places) -> tuple[jax.Array, ...]:
    """Mean squared errors of elevation and color at one place, and the share of right colors."""
    seen = patches.query(terrain.select(place.world), place.position, place.yaw)
    again = reconstruct(params, seen)
    elevation = jnp.mean((again.elevation - seen.elevation) ** 2)
    palette = terrain.class_rgb.astype(jnp.float32) / 127.5 - 1

    def nearest(rgb: jax.Array) -> jax.Array:
        return jnp.argmin(jnp.sum((rgb[..., None, :] - palette) ** 2, axis=-1), axis=-1)

    right = nearest(again.rgb) == nearest(seen.rgb)
    return elevation, jnp.mean((again.rgb - seen.rgb) ** 2), jnp.mean(right)


def near(data: PatchData, key: jax.Array, config: AutoencoderConfig) -> Places:
    """A batch of places near recorded ones, with random yaw."""
    row_key, offset_key, yaw_key = jax.random.split(key, 3)
    rows = jax.random.randint(row_key, (config.batch,), 0, len(data.places.yaw))
    places = jax.tree.map(lambda x: x[rows], data.places)
    shape = config.batch, 2
    offset = config.offset * jax.random.uniform(offset_key, shape, minval=-1.0)
    position = jax.vmap(lambda world, *args: _move(data.terrain.select(world), *args))(
        places.world, places.position, offset
    )
    yaw = jax.random.uniform(yaw_key, (config.batch,), minval=-jnp.pi, maxval=jnp.pi)
    return Places(position, yaw, places.world)


def encoders(params: Params) -> dict[str, Any]:
    """The encoders `elevation` and `semantic` of a pair of autoencoders, without the decoders."""
    return {name: {"params": params[name]["params"]["encoder"]} for name in _NETWORKS}


def reconstruct(params: Params, seen: Patches) -> Patches:
    """Patches after encoding and decoding."""
    elevation = _ELEVATION.apply(params["elevation"], seen.elevation[..., None])
    rgb = _SEMANTIC.apply(params["semantic"], seen.rgb)
    return Patches(cast(jax.Array, elevation)[..., 0], cast(jax.Array, rgb))


def _move(terrain: TerrainMap, position: jax.Array, offset: jax.Array) -> jax.Array:
    """A position `[3]` moved by `[2]` m on the map, as high above the ground as it was."""
    xy = jnp.clip(position[:2] + offset, *terrain.extent)
    above = position[2] - query.height(terrain, position[:2])
    return jnp.append(xy, query.height(terrain, xy) + above)
