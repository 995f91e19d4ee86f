"""Which world model: what it is made of, in a form that a file can hold."""

from dataclasses import replace
from typing import Annotated, Literal

import jax

from vertiwm_jax.config import AtLeastOne, Count, settings
from vertiwm_jax.mechanics.simulator import SimulatorParams
from vertiwm_jax.networks.specialist import BASE, PAPER, PAPER_WHOLE, NetworkSize
from vertiwm_jax.perception.features import Encoders, init_pair, init_reduce, init_soil
from vertiwm_jax.world_model.fusion import Coefficients, GateParams, GateTerrain
from vertiwm_jax.world_model.nesam import Nesam
from vertiwm_jax.world_model.normalization import Normalization
from vertiwm_jax.world_model.transformer import Ground, Transformer
from vertiwm_jax.world_model.verti_wm import VertiWM, VertiWMParams

Part = Literal["transformer", "nesam", "gate"]
Size = Literal["base", "paper", "paper_whole"]
SoilSource = Literal["map", "predicted"]
_SIZES: dict[Size, NetworkSize] = {"base": BASE, "paper": PAPER, "paper_whole": PAPER_WHOLE}


@settings
class ModelConfig:
    """Which model: what `VertiWM` and its parameters are made of."""

    parts: Annotated[tuple[Part, ...], AtLeastOne] = ("transformer", "nesam", "gate")
    """What of it is fitted; each part can be used alone, the gate needs both others."""
    size: Size = "base"
    """Of each specialist's network: the package's own; half of the paper's parameters, as its
    specialists have; or all of them, as its Transformers that learn from everything."""
    terrain: Ground = "patches"
    """What the Transformer is told of the ground; less than patches only to compare with."""
    soil: SoilSource = "map"
    """Whether NeSAM uses the soils of the map or predicts them from what the ground looks like."""
    vehicles: Literal["one", "any"] = "one"
    """Whether it is of the one vehicle that it is fitted to, or of any, by whose numbers NeSAM's
    physics moves it; then it learns each drive with the vehicle that the file describes."""
    encoders: Literal["own", "shared"] = "own"
    """Own ones for each specialist, as in the paper, or one pair that both share: half the cost
    where both learn from the same ground."""
    gate_terrain: GateTerrain = "mean"
    """What the gate reads of the ground."""
    coefficients: Coefficients = "grouped"
    """Fusion coefficients for four groups of motion, or one for all."""
    gates: Count = 1
    """Gates that are learned one after the other, from other first weights and other batches; the
    mean of their coefficients fuses, and where they differ the model is not sure of itself."""

    def check(self) -> None:
        if "gate" in self.parts and len(set(self.parts)) < 3:
            raise ValueError(f"parts: expected both specialists with the gate, found {self.parts}")
        if "gate" in self.parts and self.terrain != "patches":
            raise ValueError(f"terrain: expected patches for the gate, found {self.terrain!r}")
        if self.encoders == "shared" and not {"transformer", "nesam"} <= set(self.parts):
            raise ValueError(f"encoders: expected own ones for {self.parts[0]} alone, found shared")

    @property
    def transformer(self) -> Transformer:
        """The specialist for rigid ground."""
        return Transformer(_SIZES[self.size], self.terrain)

    @property
    def nesam(self) -> Nesam:
        """The specialist for soil."""
        return Nesam(_SIZES[self.size], any_vehicle=self.vehicles == "any")

    @property
    def verti_wm(self) -> VertiWM:
        """Both fused."""
        return VertiWM(self.transformer, self.nesam, self.gate_terrain, self.coefficients)

    def init_params(
        self, key: jax.Array, physics: SimulatorParams, normalization: Normalization | None = None
    ) -> VertiWMParams:
        """Untrained parameters of all parts.

        The soil predictor is among them, whatever `soil` says: see `with_soil`.
        """
        gate_key, *keys = jax.random.split(key, 3)
        first_key, transformer_key = jax.random.split(keys[0])
        second_key, nesam_key, soil_key = jax.random.split(keys[1], 3)
        first, second = init_pair(first_key), init_pair(second_key)
        soil = init_soil(soil_key)
        if self.terrain == "patches":
            channels = _SIZES[self.size].channels
            first = replace(first, reduce=init_reduce(transformer_key, channels))
        encoders: tuple[Encoders, ...] = first, replace(second, soil=soil)
        if self.encoders == "shared":
            encoders = (replace(first, soil=soil),)
        elif self.terrain != "patches":
            encoders = encoders[1:]
        return VertiWMParams(
            encoders,
            physics.vehicle,
            self.transformer.init_params(transformer_key, normalization),
            self.nesam.init_params(nesam_key, physics, normalization),
            GateParams.untrained(gate_key, self.gate_terrain, self.gates),
        )

    def with_gates(self, params: VertiWMParams, key: jax.Array) -> VertiWMParams:
        """Parameters with untrained gates added until there are as many as configured."""
        assert params.gate is not None
        more = self.gates - len(params.gate)
        if more <= 0:
            return params
        new = GateParams.untrained(key, self.gate_terrain, more)
        return replace(params, gate=params.gate.beside(new))


def with_soil(params: VertiWMParams, soil: object) -> VertiWMParams:
    """The parameters with other weights of the soil predictor, or None to use the map's soils."""
    *others, last = params.encoders
    return replace(params, encoders=(*others, replace(last, soil=soil)))
