"""Verti-WM: two specialists and the recurrent gate that fuses them, a `Dynamics` itself."""

from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.dynamics import History, Params
from vertiwm_jax.networks.gate import HIDDEN, Gate
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model import fusion
from vertiwm_jax.world_model.fusion import CONTEXT_SIZE, POSITION_AND_YAW, GateTerrain, Proposal
from vertiwm_jax.world_model.perception import Perception, Specialist

_GATE = Gate()


@struct.dataclass
class GateParams:
    """The gate, and constants that bring its context to unit size: it reads (c - mean) scale.

    A component of scale 0 is left out. Zero mean and unit scale everywhere are the paper's.

    network: of `networks.Gate`; mean, scale: `[C]`.
    """

    network: Any
    mean: jax.Array
    scale: jax.Array


@struct.dataclass
class VertiWMParams:
    """transformer, nesam: of the specialists; the paper learns `gate` after them, and alone."""

    transformer: Params
    nesam: Params
    gate: GateParams


@struct.dataclass
class VertiWMHistory:
    """h of both specialists and the gate.

    hidden: `[64]` of the gate; zeros where a window of prediction starts, in the paper.
    coefficients: `[4]` alpha that led to the current state; 0.5 before the first step.
    """

    transformer: History
    nesam: History
    hidden: jax.Array
    coefficients: jax.Array

    @property
    def perception(self) -> Perception:
        """The Transformer's, as one of the two that see the current state."""
        return self.transformer.perception


@dataclass(frozen=True)
class VertiWM:
    """Fuses a learned specialist for rigid ground with a physical one for soil (Sec. IV-C).

    gate_terrain: what the gate reads of the ground.
    coefficients: "grouped" for one each of planar and vertical motion, tilt and yaw; "scalar"
        for a single one, from the mean of the gate's outputs.
    """

    transformer: Specialist
    nesam: Specialist
    gate_terrain: GateTerrain = "mean"
    coefficients: Literal["grouped", "scalar"] = "grouped"

    def init_params(self, key: jax.Array, transformer: Params, nesam: Params) -> VertiWMParams:
        """An untrained gate, which weighs both specialists equally, over their parameters.

        Place and heading are left out of its context, lest it learn maps by heart.
        """
        mean = jnp.zeros(CONTEXT_SIZE[self.gate_terrain])
        scale = jnp.ones_like(mean).at[jnp.array(POSITION_AND_YAW)].set(0.0)
        network = _GATE.init(key, mean, jnp.zeros(HIDDEN))
        return VertiWMParams(transformer, nesam, GateParams(network, mean, scale))

    def init(
        self, params: VertiWMParams, terrain: TerrainMap, state: VehicleState
    ) -> VertiWMHistory:
        """Both specialists' histories, a gate without memory."""
        return VertiWMHistory(
            self.transformer.init(params.transformer, terrain, state),
            self.nesam.init(params.nesam, terrain, state),
            hidden=jnp.zeros(HIDDEN),
            coefficients=jnp.full(4, 0.5),
        )

    def step(
        self,
        params: VertiWMParams,
        terrain: TerrainMap,
        history: VertiWMHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, VertiWMHistory]:
        """Both specialists propose from the fused state, and see the next one."""
        by_transformer, transformer = self.transformer.propose(
            params.transformer, terrain, history.transformer, state, command
        )
        by_nesam, nesam = self.nesam.propose(params.nesam, terrain, history.nesam, state, command)
        first = Proposal.of(state, by_transformer, history.transformer.perception)
        second = Proposal.of(state, by_nesam, history.nesam.perception)

        context = fusion.context(state, command, first, second, self.gate_terrain)
        alpha, hidden = self._weigh(params.gate, context, history.hidden)
        state = fusion.fuse(state, first, second, alpha)

        seen_by_transformer, seen_by_nesam = self._look(params, terrain, state)
        return state, VertiWMHistory(
            replace(transformer, perception=seen_by_transformer),
            replace(nesam, perception=seen_by_nesam),
            hidden,
            alpha,
        )

    def _weigh(
        self, gate: GateParams, context: jax.Array, hidden: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The coefficients `[4]` and the gate's next state (Eqs. 6, 7)."""
        mean, scale = jax.lax.stop_gradient((gate.mean, gate.scale))
        outputs, hidden = cast(
            tuple[jax.Array, jax.Array],
            _GATE.apply(gate.network, (context - mean) * scale, hidden),
        )
        if self.coefficients == "scalar":
            outputs = jnp.broadcast_to(jnp.mean(outputs), outputs.shape)
        return fusion.coefficients(outputs), hidden

    def _look(
        self, params: VertiWMParams, terrain: TerrainMap, state: VehicleState
    ) -> tuple[Perception, Perception]:
        """What both see at a state: through encoders of their own, of the same patches if any."""
        patches = self.transformer.exteroception.query(terrain, state)
        seen_by_transformer = self.transformer.perceive(params.transformer, patches)
        if self.nesam.exteroception.patches != self.transformer.exteroception.patches:
            patches = self.nesam.exteroception.query(terrain, state)
        return seen_by_transformer, self.nesam.perceive(params.nesam, patches)
