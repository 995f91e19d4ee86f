"""F_N, NeSAM, the specialist of soft ground: physics and a correction (Sec. IV-B, Eq. 2)."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.mechanics.simulator import Simulator, SimulatorHistory, SimulatorParams
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.mechanics.wheel import SoilContact
from vertiwm_jax.networks.specialist import BASE, NetworkSize, SpecialistNetwork
from vertiwm_jax.networks.transformer import KeyValueCache
from vertiwm_jax.perception.features import TerrainFeatures
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.ruts import Ruts
from vertiwm_jax.world_model import motion, nesam_inputs
from vertiwm_jax.world_model.nesam_inputs import MOTION_SIGNS, StepFeatures
from vertiwm_jax.world_model.normalization import Normalization


@struct.dataclass
class NesamParams:
    """network: what is learned.

    contact, stiffening: of `SimulatorParams`, beside the vehicle.
    correction_scale: `[12]` root mean square of what physics misses in a step, as
        `motion.difference` has it.
    response: `[12, 6]` change of a proposed `motion.transition` per change of the velocities that
        it starts from, as physics typically has it.
    Constants are measured by `learning.calibration`, and never learned.
    """

    network: Any
    contact: SoilContact
    stiffening: jax.Array
    normalization: Normalization
    correction_scale: jax.Array
    response: jax.Array

    def physics(self, vehicle: Vehicle) -> SimulatorParams:
        """Of the simulator that proposes what is corrected."""
        return SimulatorParams(vehicle, self.contact, self.stiffening)


@struct.dataclass
class NesamHistory:
    """simulator: physical memory; cache: of past tokens, of each step and its mirror image.

    physics: what physics alone had made of the current state, which tells what it missed.
    """

    simulator: SimulatorHistory
    cache: KeyValueCache
    physics: VehicleState

    @property
    def ruts(self) -> Ruts | None:
        """What the wheels have pressed into the soil."""
        return self.simulator.ruts


@dataclass(frozen=True)
class Nesam:
    """The specialist F_N: a step of the simulator, whose next state is then corrected.

    The correction depends on neither place, height nor heading, and is mirrored when the vehicle
    and its ground are: the network reads every step twice, the second time as in a mirror, and the
    mean of both answers counts. It sees the ground through what physics makes of it, and by
    encoders only if they tell the soil.

    gradient: "exact" through the simulator; or "mean", several times cheaper, as if what it
        proposes depended on the velocities alone, and on them linearly (`NesamParams.response`).
        That is enough to fit models, but commands and soils have no gradient. Values are the same.
    any_vehicle: whether it has learned of many vehicles, each by its own physics, and so moves any.
    """

    size: NetworkSize = BASE
    gradient: Literal["exact", "mean"] = "mean"
    simulator: Simulator = Simulator()
    any_vehicle: bool = False

    def init_params(
        self, key: jax.Array, physics: SimulatorParams, normalization: Normalization | None = None
    ) -> NesamParams:
        """Physics as it is, and a network that leaves it so; its constants are still to measure."""
        inputs = jnp.zeros(nesam_inputs.SIZE)
        return NesamParams(
            network=self.network.init(key, inputs, None, self.size.empty_cache()),
            contact=physics.contact,
            stiffening=physics.stiffening,
            normalization=normalization or Normalization.unit(),
            correction_scale=jnp.ones(12),
            response=jnp.zeros((12, 6)),
        )

    def init(
        self, params: NesamParams, vehicle: Vehicle, terrain: TerrainMap, state: VehicleState
    ) -> NesamHistory:
        """The simulator's history, and no steps."""
        memory = self.simulator.init(params.physics(vehicle), terrain, state)
        return NesamHistory(memory, self.size.empty_cache((2,)), state)

    def propose(
        self,
        params: NesamParams,
        vehicle: Vehicle,
        terrain: TerrainMap,
        features: TerrainFeatures | None,
        history: NesamHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, NesamHistory]:
        """The next state by physics, corrected by the last 16 steps (Eq. 2)."""
        if features is not None and features.soil is not None:
            unit_weight = query.soils(terrain).unit_weight
            terrain = terrain.with_soils(replace(features.soil, unit_weight=unit_weight))
        physics, memory = self._physics(params, vehicle, terrain, history.simulator, state, command)
        constants, scale, fixed = _fixed((params.normalization, params.correction_scale, vehicle))
        step = StepFeatures.of(
            constants, scale, fixed, history.physics, state, command, physics, memory
        )
        found: Any = self.network.apply(params.network, step.both, None, history.cache)
        outputs, cache = found
        correction = scale * (0.5 * (outputs[0] + MOTION_SIGNS * outputs[1]))
        return motion.corrected(physics, correction), NesamHistory(memory, cache, physics)

    @property
    def network(self) -> SpecialistNetwork:
        """The network whose weights are `NesamParams.network`."""
        return SpecialistNetwork(self.size)

    def _physics(
        self,
        params: NesamParams,
        vehicle: Vehicle,
        terrain: TerrainMap,
        memory: SimulatorHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, SimulatorHistory]:
        """A step of the simulator, with the gradient that was asked for."""
        arguments = params.physics(vehicle), terrain, memory, state, command
        if self.gradient == "exact":
            return self.simulator.step(*arguments)
        start = _fixed(state)
        proposed, memory = _fixed(self.simulator.step(*_fixed(arguments)))
        gained = motion.twist(state) - motion.twist(start)  # zero, but for its gradient
        transition = motion.transition(start, proposed) + _fixed(params.response) @ gained
        tracked = motion.advance(state, transition)
        return jax.tree.map(lambda x, y: x + (y - _fixed(y)), proposed, tracked), memory


def _fixed(tree: Any) -> Any:
    return jax.lax.stop_gradient(tree)
