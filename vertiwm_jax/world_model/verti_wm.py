"""Verti-WM: two specialists and the recurrent gate that fuses them, a `Dynamics` itself."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.dynamics import rutted
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.networks.gate import HIDDEN
from vertiwm_jax.networks.transformer import KeyValueCache
from vertiwm_jax.perception.features import Encoders, TerrainFeatures
from vertiwm_jax.perception.perceive import perceive, reduced
from vertiwm_jax.precision import float32
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.ruts import Ruts
from vertiwm_jax.world_model import fusion, motion
from vertiwm_jax.world_model.fusion import (
    CONTEXT_SIZE,
    DIFFERENCE,
    Coefficients,
    GateParams,
    GateTerrain,
)
from vertiwm_jax.world_model.nesam import Nesam, NesamHistory, NesamParams
from vertiwm_jax.world_model.transformer import Transformer, TransformerParams


@struct.dataclass
class VertiWMParams:
    """Of the model, or of parts of it, the others being None.

    encoders: one pair that both specialists see by, or the Transformer's and NeSAM's; none if
        nothing is seen.
    vehicle: what physics moves.
    The paper learns `gate` after the specialists, and alone.
    """

    encoders: tuple[Encoders, ...]
    vehicle: Vehicle
    transformer: TransformerParams | None = None
    nesam: NesamParams | None = None
    gate: GateParams | None = None


@struct.dataclass
class VertiWMHistory:
    """What goes with a state of the fused vehicle.

    features: of the ground there, by each pair of encoders.
    transformer, nesam: h of the specialists; hidden: `[G, 64]` of the gates, zeros at first.
    context: `[C]` what the gates read of the last step; zeros before the first one.
    alphas: `[G, 4]` what each gate made of it; 0.5 before the first step.
    """

    features: tuple[TerrainFeatures, ...]
    transformer: KeyValueCache
    nesam: NesamHistory
    hidden: jax.Array
    context: jax.Array
    alphas: jax.Array

    @property
    def ruts(self) -> Ruts | None:
        """What the wheels have pressed into the soil, if NeSAM is asked to remember it."""
        return self.nesam.ruts

    @property
    def coefficients(self) -> jax.Array:
        """`[..., 4]` alpha that led to the current state."""
        return jnp.mean(self.alphas, axis=-2)

    @property
    def disagreement(self) -> jax.Array:
        """`[...]` m between where the two would have moved it, without a gradient."""
        return jnp.linalg.norm(self._apart[..., :3], axis=-1)

    @property
    def spread(self) -> jax.Array:
        """`[...]` m, the standard deviation of where each gate by itself would have moved it.

        Without a gradient; 0 of a single gate.
        """
        differ = fusion.weights(jnp.std(jax.lax.stop_gradient(self.alphas), axis=-2))
        return jnp.linalg.norm((differ * self._apart)[..., :3], axis=-1)

    @property
    def _apart(self) -> jax.Array:
        return jax.lax.stop_gradient(self.context)[..., DIFFERENCE]


@dataclass(frozen=True)
class VertiWM:
    """Fuses a learned specialist for rigid ground with a physical one for soil (Sec. IV-C).

    gate_terrain: what the gates read of the ground.
    coefficients: of which groups of motion there is one each.
    latents: whether histories keep those that the Transformer sees, for a policy to see them, or
        for `Encoders.reduce` to be learned.
    """

    transformer: Transformer = Transformer()
    nesam: Nesam = Nesam()
    gate_terrain: GateTerrain = "mean"
    coefficients: Coefficients = "grouped"
    latents: bool = False

    @float32
    def init(
        self, params: VertiWMParams, terrain: TerrainMap, state: VehicleState
    ) -> VertiWMHistory:
        """Both specialists' histories, gates without memory, and a look at the ground."""
        assert params.transformer and params.nesam and params.gate
        gates, vehicle = len(params.gate), params.vehicle
        return VertiWMHistory(
            self.see(params, terrain, state),
            self.transformer.init(params.transformer, vehicle, terrain, state),
            self.nesam.init(params.nesam, vehicle, terrain, state),
            hidden=jnp.zeros((gates, HIDDEN)),
            context=jnp.zeros(CONTEXT_SIZE[self.gate_terrain]),
            alphas=jnp.full((gates, 4), 0.5, jnp.float32),
        )

    @float32
    def see(
        self, params: VertiWMParams, terrain: TerrainMap, state: VehicleState
    ) -> tuple[TerrainFeatures, ...]:
        """What each pair of encoders makes of the ground at a state (Eq. 1)."""
        return perceive(params.encoders, terrain, state, self.latents)

    @float32
    def step(
        self,
        params: VertiWMParams,
        terrain: TerrainMap,
        history: VertiWMHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, VertiWMHistory]:
        """The state 0.1 s later, and the history that goes with it."""
        assert params.transformer and params.nesam and params.gate
        # What F_T and F_N see at the current pose (Eq. 1); the same if they share encoders.
        features = reduced(params.encoders, history.features)
        seen_t, seen_n = features[0], features[-1]
        # Both propose a next state (Eq. 2).
        next_t, memory_t = self.transformer.propose(
            params.transformer, params.vehicle, terrain, seen_t, history.transformer, state, command
        )
        next_n, memory_n = self.nesam.propose(
            params.nesam, params.vehicle, terrain, seen_n, history.nesam, state, command
        )
        # Their motion in the current body frame (Eq. 3).
        xi_t, xi_n = motion.increment(state, next_t), motion.increment(state, next_n)
        nu_t, nu_n = motion.twist(next_t), motion.twist(next_n)
        # The gates read ground, state, command and proposals, these without a gradient
        # (Eqs. 4, 5).
        context = fusion.context(
            self.gate_terrain, seen_n.average, seen_t.average, state, command, xi_n, xi_t
        )
        outputs, hidden = fusion.run_gates(params.gate, context, history.hidden)
        # Coefficients of each gate, whose mean fuses (Eqs. 6, 7).
        alphas = fusion.coefficients(outputs, self.coefficients)
        beta = fusion.weights(jnp.mean(alphas, axis=0))
        # The fused transition (Eq. 8).
        xi = xi_t + beta * (xi_n - xi_t)
        nu = nu_t + beta * (nu_n - nu_t)
        state = motion.moved(state, xi, nu)
        seen = self.see(params, rutted(terrain, memory_n), state)
        return state, VertiWMHistory(seen, memory_t, memory_n, hidden, context, alphas)
