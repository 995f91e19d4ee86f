"""Learning what soils look like: the soil predictor on the semantic latents of recorded places."""

from dataclasses import dataclass
from typing import cast

import jax
import jax.numpy as jnp

from vertiwm_jax import parallel
from vertiwm_jax.dynamics import Params
from vertiwm_jax.learning.autoencoders import AutoencoderConfig, PatchData, Places, near
from vertiwm_jax.networks.encoder import TerrainEncoder
from vertiwm_jax.networks.soil_predictor import SoilPredictor
from vertiwm_jax.terrain import patches, query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import BOUNDS, Soil, to_unit

_ENCODER, _NETWORK = TerrainEncoder(3), SoilPredictor()


@dataclass(frozen=True)
class SoilProblem:
    """A `fitting.Problem`: the soil under the vehicle, from what the ground around it looks like.

    The map's own soils supervise; places on rigid ground teach nothing. Parameters are
    `semantic`, the frozen encoder of colors, and `soil`.
    """

    config: AutoencoderConfig

    @property
    def batch(self) -> int:
        return self.config.batch

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
        latent = cast(jax.Array, _ENCODER.apply(encoder, seen.rgb))
        predicted = cast(Soil, _NETWORK.apply(params["soil"], latent, jnp.float32(0)))
        kind = query.surface(world, place.position[:2]).semantic
        true = query.soil(world, kind)
        soft = terrain.deformable[kind].astype(jnp.float32)
        return soft * (to_unit(predicted) - to_unit(true)), soft
