"""F_T, the specialist of rigid ground: a causal Transformer (Sec. IV-B, Eq. 2)."""

from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.networks.specialist import BASE, NetworkSize, SpecialistNetwork
from vertiwm_jax.networks.transformer import KeyValueCache
from vertiwm_jax.perception.features import CELLS, TerrainFeatures
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model import motion
from vertiwm_jax.world_model.normalization import INPUTS, Normalization

Ground = Literal["patches", "indicator", "none"]
"""What the Transformer is told of the ground."""


@struct.dataclass
class TransformerParams:
    """network: what is learned, with `Encoders.reduce`; normalization: measured, never learned."""

    network: Any
    normalization: Normalization


@dataclass(frozen=True)
class Transformer:
    """The specialist F_T; what it predicts depends on neither place, height nor heading.

    terrain: what it is told of the ground at the pose: encoded "patches"; the "indicator" of
        NRD (Zhang et al., 2026), 1 on soil and 0 on rigid ground; or "none".
    """

    size: NetworkSize = BASE
    terrain: Ground = "patches"

    def init_params(
        self, key: jax.Array, normalization: Normalization | None = None
    ) -> TransformerParams:
        """Untrained weights; without constants, quantities are left in their units."""
        ground = {"patches": CELLS * self.size.channels, "indicator": 1, "none": 0}[self.terrain]
        seen = jnp.zeros(ground) if ground else None
        network = self.network.init(key, jnp.zeros(INPUTS), seen, self.size.empty_cache())
        return TransformerParams(network, normalization or Normalization.unit())

    def init(
        self, params: TransformerParams, vehicle: Vehicle, terrain: TerrainMap, state: VehicleState
    ) -> KeyValueCache:
        """A history without steps."""
        del params, vehicle, terrain, state
        return self.size.empty_cache()

    def propose(
        self,
        params: TransformerParams,
        vehicle: Vehicle,
        terrain: TerrainMap,
        features: TerrainFeatures | None,
        history: KeyValueCache,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, KeyValueCache]:
        """The next state by the last 16 steps and what was seen in them (Eq. 2)."""
        inputs = params.normalization.inputs(state, command)
        ground = self._ground(terrain, features, state)
        found: Any = self.network.apply(params.network, inputs, ground, history)
        outputs, cache = found
        return motion.advance(state, params.normalization.transition(outputs)), cache

    @property
    def network(self) -> SpecialistNetwork:
        """The network whose weights are `TransformerParams.network`."""
        return SpecialistNetwork(self.size)

    def _ground(
        self, terrain: TerrainMap, features: TerrainFeatures | None, state: VehicleState
    ) -> jax.Array | None:
        if self.terrain == "patches":
            assert features is not None, "without encoders it sees no patches"
            return features.reduced
        if self.terrain == "indicator":
            below = query.surface(terrain, state.position[..., :2])
            return terrain.deformable[below.semantic][..., None].astype(jnp.float32)
        return None
