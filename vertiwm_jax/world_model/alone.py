"""One specialist as a model of its own."""

from dataclasses import dataclass, replace
from typing import Any

from flax import struct

from vertiwm_jax.dynamics import History, rutted
from vertiwm_jax.perception.features import Encoders, TerrainFeatures
from vertiwm_jax.perception.perceive import perceive, reduced
from vertiwm_jax.precision import float32
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.ruts import Ruts
from vertiwm_jax.world_model.nesam import Nesam
from vertiwm_jax.world_model.transformer import Transformer
from vertiwm_jax.world_model.verti_wm import VertiWMParams


@struct.dataclass
class AloneHistory:
    """features: of the ground at the current state; none of a specialist that sees nothing.

    specialist: its own history.
    """

    features: tuple[TerrainFeatures, ...]
    specialist: History

    @property
    def ruts(self) -> Ruts | None:
        """What the wheels have pressed into the soil, if NeSAM is asked to remember it."""
        return getattr(self.specialist, "ruts", None)


@dataclass(frozen=True)
class Alone:
    """The `Dynamics` of one specialist: it proposes, and is where it has proposed to be.

    It reads its part of `VertiWMParams`.
    latents: as of `VertiWM`.
    """

    specialist: Transformer | Nesam
    latents: bool = False

    @float32
    def init(self, params: VertiWMParams, terrain: TerrainMap, state: VehicleState) -> AloneHistory:
        """The specialist's history, and a look at the ground."""
        begun = self.specialist.init(self._own(params), params.vehicle, terrain, state)
        return AloneHistory(self.see(params, terrain, state), begun)

    @float32
    def see(
        self, params: VertiWMParams, terrain: TerrainMap, state: VehicleState
    ) -> tuple[TerrainFeatures, ...]:
        """What the specialist needs to know of the ground at a state (Eq. 1)."""
        encoders = self._encoders(params.encoders)
        return perceive(encoders, terrain, state, self.latents) if encoders else ()

    @float32
    def step(
        self,
        params: VertiWMParams,
        terrain: TerrainMap,
        history: AloneHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, AloneHistory]:
        """The proposed state (Eq. 2), and a look at the ground there."""
        own, seen = self._own(params), None
        if history.features:
            (seen,) = reduced(self._encoders(params.encoders), history.features)
        state, after = self.specialist.propose(
            own, params.vehicle, terrain, seen, history.specialist, state, command
        )
        return state, AloneHistory(self.see(params, rutted(terrain, after), state), after)

    def part_of(self, params: VertiWMParams) -> VertiWMParams:
        """The parameters without what it does not read."""
        own = {self._name: self._own(params)}
        return VertiWMParams(self._encoders(params.encoders), params.vehicle, **own)

    @property
    def _name(self) -> str:
        return "transformer" if isinstance(self.specialist, Transformer) else "nesam"

    def _own(self, params: VertiWMParams) -> Any:
        return getattr(params, self._name)

    def _encoders(self, encoders: tuple[Encoders, ...]) -> tuple[Encoders, ...]:
        """Those of the specialist, without what it does not ask."""
        if isinstance(self.specialist, Nesam):
            return tuple(replace(x, reduce=None) for x in encoders[-1:] if x.soil is not None)
        sees = self.specialist.terrain == "patches"
        return tuple(replace(x, soil=None) for x in encoders[:1]) if sees else ()
