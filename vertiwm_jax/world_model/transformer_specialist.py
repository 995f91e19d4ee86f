"""F_T: a causal Transformer over states, commands and encoded terrain (Sec. IV-B)."""

from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.networks.encoder import LATENT_CHANNELS, Fours, in_rows
from vertiwm_jax.networks.transformer import KeyValueCache
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model import motion
from vertiwm_jax.world_model.normalisation import LOCAL, Normalisation
from vertiwm_jax.world_model.perception import (
    EncoderParams,
    Exteroception,
    Glance,
    Perception,
    Remembers,
    View,
    glance,
)
from vertiwm_jax.world_model.sizes import BASE, TransformerSize
from vertiwm_jax.world_model.specialist_network import Ground, Reduction, SpecialistNetwork


@struct.dataclass
class TransformerParams:
    """network: what is learned; encoders: frozen by default, None without terrain patches."""

    network: Any
    encoders: EncoderParams | None
    normalisation: Normalisation


@struct.dataclass
class TransformerHistory:
    """cache: of the past tokens; perception: of the current state, None without patches."""

    cache: KeyValueCache
    perception: Perception | Glance | None


@dataclass(frozen=True)
class TransformerSpecialist:
    """The `Dynamics` F_T; what it predicts depends on neither place, height nor heading.

    terrain: what it is told of the ground at the pose: encoded "patches"; the "indicator" of
        NRD (Zhang et al., 2026), 1 on soil and 0 on rigid ground; or "none".
    exteroception: how it looks at patches.
    remembers: what its history has of a look: the "latents"; or a "glance", which takes a CPU less
        time, but what makes it of the latents cannot be learned so: asking for a gradient raises.
    """

    size: TransformerSize = BASE
    terrain: Literal["patches", "indicator", "none"] = "patches"
    exteroception: Exteroception = Exteroception()
    remembers: Remembers = "latents"

    def __post_init__(self) -> None:
        if self.remembers == "glance" and self.terrain != "patches":
            raise ValueError("remembers: expected latents without patches, found glance")

    def init_params(
        self, key: jax.Array, normalisation: Normalisation | None = None
    ) -> TransformerParams:
        """Untrained weights; without constants, quantities are left in their units."""
        encoder_key, network_key = jax.random.split(key)
        encoders, ground = None, None
        if self.terrain == "patches":
            encoders = self.exteroception.init_params(encoder_key)
            ground = Perception(*jnp.zeros((2, 1, 16, 16, LATENT_CHANNELS)))
        elif self.terrain == "indicator":
            ground = jnp.zeros((1, 1))
        network = self._network.init(network_key, jnp.zeros((1, LOCAL.size + 2)), ground)
        return TransformerParams(network, encoders, normalisation or Normalisation.unit())

    def init(
        self, params: TransformerParams, terrain: TerrainMap, state: VehicleState
    ) -> TransformerHistory:
        """An empty cache and a look at the ground."""
        begun = self.begin(params, terrain, state)
        return replace(begun, perception=self.look(params, terrain, state))

    def begin(
        self, params: TransformerParams, terrain: TerrainMap, state: VehicleState
    ) -> TransformerHistory:
        """`init` without the look."""
        del terrain, state
        empty = self._network.apply(params.network, method=SpecialistNetwork.empty_cache)
        return TransformerHistory(cast(KeyValueCache, empty), None)

    def step(
        self,
        params: TransformerParams,
        terrain: TerrainMap,
        history: TransformerHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, TransformerHistory]:
        """The next state, and a look at the ground there."""
        state, history = self.propose(params, terrain, history, state, command)
        return state, replace(history, perception=self.look(params, terrain, state))

    def propose(
        self,
        params: TransformerParams,
        terrain: TerrainMap,
        history: TransformerHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, TransformerHistory]:
        """`step` up to the next state; `history.perception` is still that of `state`."""
        inputs = self._inputs(params, terrain, state, command, history.perception)
        output, cache = cast(
            tuple[jax.Array, KeyValueCache],
            self._network.apply(
                params.network, *inputs, history.cache, method=SpecialistNetwork.step
            ),
        )
        proposed = motion.advance(state, params.normalisation.transition(output))
        return proposed, replace(history, cache=cache)

    def follow(
        self,
        params: TransformerParams,
        terrain: TerrainMap,
        states: VehicleState,
        commands: Command,
    ) -> VehicleState:
        """A step from every state of a recorded drive: leaves `[T, 3]`, commands `[T]`.

        What `step` gives from each of them with the history of those before, all at once.
        """
        perception = jax.vmap(lambda state: self.look(params, terrain, state))(states)
        inputs = self._inputs(params, terrain, states, commands, perception)
        output = cast(jax.Array, self._network.apply(params.network, *inputs))
        return motion.advance(states, params.normalisation.transition(output))

    @property
    def _network(self) -> SpecialistNetwork:
        return SpecialistNetwork(self.size)

    def look(
        self, params: TransformerParams, terrain: TerrainMap, state: VehicleState
    ) -> Perception | Glance | None:
        """What it remembers of a look at the ground."""
        if self.terrain != "patches":
            return None
        return self.exteroception.look((self.view(params),), terrain, state)[0]

    def view(self, params: TransformerParams) -> View:
        """How it looks at patches."""
        assert params.encoders is not None, "without encoders it cannot look at patches"
        if self.remembers == "latents":
            return View(params.encoders)
        return View(params.encoders, _glance, _not_learned(params.network["params"]["reduce"]))

    def _inputs(
        self,
        params: TransformerParams,
        terrain: TerrainMap,
        state: VehicleState,
        command: Command,
        perception: Perception | Glance | None,
    ) -> tuple[jax.Array, Ground]:
        """What the network reads: motion `[..., 10]` and the ground."""
        constants = params.normalisation
        parts = constants.state(state.vector), constants.command(command.vector)
        ground = perception
        if self.terrain == "indicator":
            below = query.surface(terrain, state.position[..., :2])
            soil = terrain.deformable[below.semantic]
            ground = soil[..., None].astype(jnp.float32)
        return jnp.concatenate(parts, axis=-1), ground


def _glance(reduction: Any, elevation: Fours, semantic: Fours) -> Glance:
    network = Reduction(channels=len(reduction["bias"]))
    reduced = cast(jax.Array, network.apply({"params": reduction}, elevation, semantic))
    return replace(glance(None, elevation, semantic), reduced=in_rows(reduced).ravel())


@jax.custom_jvp
def _not_learned(weights: Any) -> Any:
    return weights


@_not_learned.defjvp
def _raise(primals: Any, tangents: Any) -> Any:
    raise TypeError(
        "remembers: expected latents to learn the weights of a Transformer, found glance; see "
        "world_model.choice.lean"
    )
