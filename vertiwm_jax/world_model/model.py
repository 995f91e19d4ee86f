"""Verti-WM: two specialists and the recurrent gate that fuses them, a `Dynamics` itself."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self, cast

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax import checkpoints
from vertiwm_jax import config as configuration
from vertiwm_jax.dynamics import History, Params
from vertiwm_jax.mechanics.simulator import SimulatorParams, chrono_like
from vertiwm_jax.mechanics.vehicle import hmmwv
from vertiwm_jax.networks.gate import HIDDEN, Gate
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model import fusion
from vertiwm_jax.world_model.fusion import CONTEXT_SIZE, POSITION_AND_YAW, GateTerrain, Proposal
from vertiwm_jax.world_model.nesam import Nesam, SoilSource
from vertiwm_jax.world_model.normalisation import Normalisation
from vertiwm_jax.world_model.perception import Glance, Perception, Specialist
from vertiwm_jax.world_model.sizes import BASE, PAPER, TransformerSize
from vertiwm_jax.world_model.transformer_specialist import TransformerSpecialist

Part = Literal["transformer", "nesam", "gate"]
Size = Literal["base", "paper"]
Encoders = Literal["own", "shared"]
"""Whether each specialist has a pair of encoders, or NeSAM sees through the Transformer's."""
PRETRAINED = Path(__file__).parents[1] / "weights"
"""Folder of the model that comes with the package; its model card is `docs/model_card.md`."""
_CONFIG = "model.yaml"
_CONSTANT = 1e-6
_SIZES: dict[Size, TransformerSize] = {"base": BASE, "paper": PAPER}
_GATE = Gate()


@struct.dataclass
class GateParams:
    """G gates, and constants that bring their context to unit size: they read (c - mean) scale.

    A component of scale 0 is left out. Zero mean and unit scale everywhere are the paper's, and so
    is a single gate.

    network: of `networks.Gate`, leaves `[G, ...]`; mean, scale: `[C]`.
    """

    network: Any
    mean: jax.Array
    scale: jax.Array

    def __len__(self) -> int:
        """G."""
        return len(jax.tree.leaves(self.network)[0])

    def only(self, number: int) -> Self:
        """One of them."""
        return replace(self, network=jax.tree.map(lambda x: x[number : number + 1], self.network))

    def beside(self, *others: "GateParams") -> Self:
        """These and others, with the constants of these."""
        networks = [gates.network for gates in (self, *others)]
        return replace(self, network=jax.tree.map(lambda *x: jnp.concatenate(x), *networks))


@struct.dataclass
class VertiWMParams:
    """transformer, nesam: of the specialists; the paper learns `gate` after them, and alone."""

    transformer: Params
    nesam: Params
    gate: GateParams


@struct.dataclass
class VertiWMHistory:
    """h of both specialists and the gate; what both see alike is in the Transformer's alone.

    hidden: `[G, 64]` of the gates; zeros where a window of prediction starts, in the paper.
    coefficients: `[4]` alpha that led to the current state; 0.5 before the first step.
    disagreement: `[]` m between where the two would have moved it, without a gradient; 0 before
        the first step.
    spread: `[]` m, the standard deviation of where each gate by itself would have moved it, without
        a gradient; 0 before the first step, and of a single gate.
    """

    transformer: History
    nesam: History
    hidden: jax.Array
    coefficients: jax.Array
    disagreement: jax.Array
    spread: jax.Array

    @property
    def perception(self) -> Perception | Glance:
        """The Transformer's, as one of the two that see the current state."""
        return self.transformer.perception


@dataclass(frozen=True)
class ModelConfig:
    """Which model: what `VertiWM` is made of, in a form that a file can hold."""

    parts: tuple[Part, ...] = ("transformer", "nesam", "gate")
    """What of it is fitted; each part can be used alone, the gate needs both others."""
    size: Size = "base"
    """Of both specialists' networks."""
    terrain: Literal["patches", "indicator", "none"] = "patches"
    """What the Transformer is told of the ground; less than patches only to compare with."""
    soil: SoilSource = "map"
    """Whether NeSAM uses the soils of the map or predicts them from what the ground looks like."""
    encoders: Encoders = "own"
    """Own ones for each specialist, as in the paper, or one pair that both share: half the cost
    where both learn from the same ground."""
    gate_terrain: GateTerrain = "mean"
    """What the gate reads of the ground."""
    coefficients: Literal["grouped", "scalar"] = "grouped"
    """Fusion coefficients for four groups of motion, or one for all."""
    gates: int = 1
    """Gates that are learned one after the other, from other first weights and other batches; the
    mean of their coefficients fuses, and where they differ the model is not sure of itself."""

    def __post_init__(self):
        if not self.parts:
            raise ValueError("parts: expected at least one, found none")
        if "gate" in self.parts and len(set(self.parts)) < 3:
            raise ValueError(f"parts: expected both specialists with the gate, found {self.parts}")
        if "gate" in self.parts and self.terrain != "patches":
            raise ValueError(f"terrain: expected patches for the gate, found {self.terrain!r}")
        if self.encoders == "shared" and not {"transformer", "nesam"} <= set(self.parts):
            raise ValueError(f"encoders: expected own ones for {self.parts[0]} alone, found shared")
        if self.gates < 1:
            raise ValueError(f"gates: expected at least 1, found {self.gates}")

    @property
    def transformer(self) -> TransformerSpecialist:
        """The specialist for rigid ground."""
        return TransformerSpecialist(_SIZES[self.size], self.terrain)

    @property
    def nesam(self) -> Nesam:
        """The specialist for soil."""
        return Nesam(_SIZES[self.size], soil=self.soil)

    def build(self) -> "VertiWM":
        """Both fused."""
        return VertiWM(
            self.transformer, self.nesam, self.encoders, self.gate_terrain, self.coefficients
        )

    def init_params(
        self,
        key: jax.Array,
        simulator: SimulatorParams,
        normalisation: Normalisation | None = None,
    ) -> VertiWMParams:
        """Untrained parameters of all parts."""
        keys = jax.random.split(key, 3)
        return self.build().init_params(
            keys[0],
            self.transformer.init_params(keys[1], normalisation),
            self.nesam.init_params(keys[2], simulator, normalisation),
            self.gates,
        )

    def with_gates(self, params: VertiWMParams, key: jax.Array) -> VertiWMParams:
        """Parameters with untrained gates added until there are as many as configured."""
        more = self.gates - len(params.gate)
        if more <= 0:
            return params
        new = self.build().init_params(key, params.transformer, params.nesam, more).gate
        return replace(params, gate=params.gate.beside(new))


@dataclass(frozen=True)
class VertiWM:
    """Fuses a learned specialist for rigid ground with a physical one for soil (Sec. IV-C).

    encoders: "shared" if NeSAM's are the Transformer's, so that the ground is encoded only once.
    gate_terrain: what the gate reads of the ground.
    coefficients: "grouped" for one each of planar and vertical motion, tilt and yaw; "scalar"
        for a single one, from the mean of the gate's outputs.
    """

    transformer: Specialist
    nesam: Specialist
    encoders: Encoders = "own"
    gate_terrain: GateTerrain = "mean"
    coefficients: Literal["grouped", "scalar"] = "grouped"

    def __post_init__(self) -> None:
        if getattr(self.transformer, "remembers", "latents") == "glance" and self.looks_at_both:
            raise ValueError(
                "transformer.remembers: expected latents, of which NeSAM, which shares encoders, "
                "predicts soils, found glance"
            )

    @property
    def looks_at_both(self) -> bool:
        """Whether latents that the Transformer's network reads are read by NeSAM as well."""
        return self.encoders == "shared" and getattr(self.nesam, "soil", "map") == "predicted"

    def init_params(
        self, key: jax.Array, transformer: Params, nesam: Params, gates: int = 1
    ) -> VertiWMParams:
        """Untrained gates, which weigh both specialists equally, over their parameters.

        Place and heading are left out of their context, lest they learn maps by heart.
        """
        mean = jnp.zeros(CONTEXT_SIZE[self.gate_terrain])
        scale = jnp.ones_like(mean).at[jnp.array(POSITION_AND_YAW)].set(0.0)
        keys = jax.random.split(key, gates)
        network = jax.vmap(lambda key: _GATE.init(key, mean, jnp.zeros(HIDDEN)))(keys)
        return VertiWMParams(transformer, nesam, GateParams(network, mean, scale))

    @classmethod
    def pretrained(cls) -> tuple[Self, VertiWMParams]:
        """The model that comes with the package, for a HMMWV, and its parameters."""
        config, params = load(PRETRAINED)
        return cast(Self, config.build()), params

    def init(
        self, params: VertiWMParams, terrain: TerrainMap, state: VehicleState
    ) -> VertiWMHistory:
        """Both specialists' histories, gates without memory."""
        history = VertiWMHistory(
            self.transformer.begin(params.transformer, terrain, state),
            self.nesam.begin(params.nesam, terrain, state),
            hidden=jnp.zeros((len(params.gate), HIDDEN)),
            coefficients=jnp.full(4, 0.5, jnp.float32),
            disagreement=jnp.float32(0),
            spread=jnp.float32(0),
        )
        return self._seeing(params, terrain, history, state)

    def step(
        self,
        params: VertiWMParams,
        terrain: TerrainMap,
        history: VertiWMHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, VertiWMHistory]:
        """Both specialists propose from the fused state, and see the next one."""
        first, second, following = self._propose(params, terrain, history, state, command)
        context = fusion.context(state, command, first, second, self.gate_terrain)
        alphas, hidden = self.weigh(params.gate, context, history.hidden)
        alpha = jnp.mean(alphas, axis=0)
        apart, given = jax.lax.stop_gradient((second.increment - first.increment, alphas))
        following = replace(
            following,
            hidden=hidden,
            coefficients=alpha,
            disagreement=jnp.linalg.norm(apart[:3]),
            spread=jnp.linalg.norm((fusion.weights(jnp.std(given, axis=0)) * apart)[:3]),
        )
        state = fusion.fuse(state, first, second, alpha)
        return state, self._seeing(params, terrain, following, state)

    def context_along(
        self,
        params: VertiWMParams,
        terrain: TerrainMap,
        states: VehicleState,
        commands: Command,
    ) -> jax.Array:
        """`[T, C]` what the gate reads at every recorded state; leaves `[T, 3]`, commands `[T]`."""

        def advance(
            history: VertiWMHistory, inputs: tuple[VehicleState, Command]
        ) -> tuple[VertiWMHistory, jax.Array]:
            state, command = inputs
            history = self._seeing(params, terrain, history, state)
            first, second, following = self._propose(params, terrain, history, state, command)
            return following, fusion.context(state, command, first, second, self.gate_terrain)

        first = jax.tree.map(lambda x: x[0], states)
        return jax.lax.scan(advance, self.init(params, terrain, first), (states, commands))[1]

    def _propose(
        self,
        params: VertiWMParams,
        terrain: TerrainMap,
        history: VertiWMHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[Proposal, Proposal, VertiWMHistory]:
        """What the Transformer and NeSAM would do, and their histories after it."""
        by_transformer, transformer = self.transformer.propose(
            params.transformer, terrain, history.transformer, state, command
        )
        kept = history.nesam.perception
        seen = history.perception if self.encoders == "shared" else kept
        by_nesam, nesam = self.nesam.propose(
            params.nesam, terrain, replace(history.nesam, perception=seen), state, command
        )
        first = Proposal.of(state, by_transformer, history.perception)
        second = Proposal.of(state, by_nesam, seen)
        nesam = replace(nesam, perception=kept)
        return first, second, replace(history, transformer=transformer, nesam=nesam)

    def weigh(
        self, gate: GateParams, context: jax.Array, hidden: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The coefficients of each gate `[G, 4]`, and its next state `[G, 64]` (Eqs. 6, 7)."""
        mean, scale = jax.lax.stop_gradient((gate.mean, gate.scale))
        seen = (context - mean) * scale
        outputs, hidden = cast(
            tuple[jax.Array, jax.Array],
            jax.vmap(lambda network, hidden: _GATE.apply(network, seen, hidden))(
                gate.network, hidden
            ),
        )
        if self.coefficients == "scalar":
            outputs = jnp.broadcast_to(jnp.mean(outputs, axis=-1, keepdims=True), outputs.shape)
        return fusion.coefficients(outputs), hidden

    def _seeing(
        self,
        params: VertiWMParams,
        terrain: TerrainMap,
        history: VertiWMHistory,
        state: VehicleState,
    ) -> VertiWMHistory:
        """The history with what both see at a state."""
        by_transformer, by_nesam = self.look(params, terrain, state)
        return replace(
            history,
            transformer=replace(history.transformer, perception=by_transformer),
            nesam=replace(history.nesam, perception=by_nesam),
        )

    def look(
        self, params: VertiWMParams, terrain: TerrainMap, state: VehicleState
    ) -> tuple[Perception | Glance, Perception | Glance | None]:
        """What the Transformer sees at a state, and NeSAM if it has encoders of its own."""
        look = self.transformer.exteroception.look
        of_first = self.transformer.view(params.transformer)
        if self.encoders == "shared":
            return look((of_first,), terrain, state)[0], None
        by_transformer, by_nesam = look((of_first, self.nesam.view(params.nesam)), terrain, state)
        return by_transformer, by_nesam


def calibrate(
    model: VertiWM,
    params: VertiWMParams,
    terrain: TerrainMap,
    states: VehicleState,
    commands: Command,
) -> VertiWMParams:
    """The parameters with the constants of the gate's context measured on recorded drives.

    states: leaves `[N, T + 1, 3]` on the worlds `terrain.world` `[N]`; commands: leaves `[N, T]`.
    """

    def one(world: jax.Array, states: VehicleState, commands: Command) -> jax.Array:
        before = jax.tree.map(lambda x: x[:-1], states)
        return model.context_along(params, terrain.select(world), before, commands)

    context = jax.jit(jax.vmap(one))(terrain.world, states, commands)
    context = context.reshape(-1, context.shape[-1])
    deviation = jnp.std(context, axis=0)
    scale = jnp.where(deviation > _CONSTANT, 1 / jnp.maximum(deviation, _CONSTANT), 0.0)
    scale = scale.at[jnp.array(POSITION_AND_YAW)].set(0.0)
    gate = replace(params.gate, mean=jnp.mean(context, axis=0), scale=scale)
    return replace(params, gate=gate)


def save(folder: Path, config: ModelConfig, params: VertiWMParams) -> None:
    """Write a model to `folder`, for `load`, in place of one there; as `checkpoints.save`."""
    before = checkpoints.latest(folder)
    checkpoints.save(folder, int(before.name) + 1 if before else 0, params, keep=1)
    configuration.save(config, folder / _CONFIG)


def load(folder: Path) -> tuple[ModelConfig, VertiWMParams]:
    """What `save` wrote to `folder`; parts that are not among the configured ones are untrained.

    `ConfigError` or `CheckpointError` when it holds none, or one of another version.
    """
    config = configuration.load(ModelConfig, folder / _CONFIG)
    path = checkpoints.latest(folder)
    if path is None:
        raise checkpoints.CheckpointError(f"{folder}: expected the weights of a model, found none")
    like = jax.eval_shape(
        lambda key: config.init_params(key, chrono_like(hmmwv())), jax.random.key(0)
    )
    return config, checkpoints.load(path, like)
