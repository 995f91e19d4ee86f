"""The built-in simulator behind the interface of simulators outside jit."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax import geometry
from vertiwm_jax.learning.dataset import WheelSignals
from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.mechanics.simulator import (
    GroundForces,
    Simulator,
    SimulatorHistory,
    SimulatorParams,
    chrono_like,
)
from vertiwm_jax.mechanics.vehicle import Vehicle, load_vehicle
from vertiwm_jax.simulators.protocol import SETTLE_SECONDS, Observation, under_wheels
from vertiwm_jax.state import STEP_SECONDS, Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap

DYNAMICS = Simulator()


@struct.dataclass
class _Moving:
    """The vehicle under way; forces: means over the last step."""

    state: VehicleState
    history: SimulatorHistory
    forces: GroundForces


class BuiltIn:
    """A vehicle on the selected world of a map, compiled once for all maps of one size.

    Obstacles are ignored. vehicle: the HMMWV by default.
    """

    def __init__(self, terrain: TerrainMap, vehicle: Vehicle | None = None) -> None:
        self._terrain, self._params = terrain, chrono_like(vehicle or load_vehicle())

    def start(self, x: float, y: float, yaw: float) -> Observation:
        """As `Simulator.start`."""
        pose = np.array([x, y, yaw], np.float32)
        self._moving = _place(self._params, self._terrain, pose)
        for _ in range(round(SETTLE_SECONDS / STEP_SECONDS) - 1):
            self.step(np.zeros(2))
        return self.step(np.zeros(2))

    def step(self, command: np.ndarray) -> Observation:
        """As `Simulator.step`."""
        command = np.asarray(command, np.float32)
        self._moving, seen = _step(self._params, self._terrain, self._moving, command)
        return jax.device_get(seen)


@jax.jit
def _place(params: SimulatorParams, terrain: TerrainMap, pose: jax.Array) -> _Moving:
    state = place(terrain, pose[:2], pose[2], vehicle=params.vehicle)
    history, none = DYNAMICS.init(params, terrain, state), jnp.zeros((4, 3))
    return _Moving(state, history, GroundForces(none, none[0]))


@jax.jit
def _step(
    params: SimulatorParams, terrain: TerrainMap, moving: _Moving, command: jax.Array
) -> tuple[_Moving, Observation]:
    state, history, forces = DYNAMICS.step_with_forces(
        params, terrain, moving.history, moving.state, Command.from_vector(command)
    )
    moving = _Moving(state, history, jax.tree.map(lambda x: jnp.mean(x, axis=0), forces))
    return moving, _observe(params, terrain, moving)


def _observe(params: SimulatorParams, terrain: TerrainMap, moving: _Moving) -> Observation:
    state, history, vehicle = moving.state, moving.history, params.vehicle
    rotation = geometry.rotation_from_rpy(state.rpy).as_matrix()
    in_body = jnp.concatenate([vehicle.wheel_position, history.travel[:, None]], axis=-1)
    # Written out: a matmul may round map coordinates to ten bits on an accelerator.
    center = state.position + jnp.sum(rotation * in_body[:, None, :], axis=-1)
    wheel_class, depth = under_wheels(terrain, center, vehicle.wheel_radius)
    wheels = WheelSignals(
        wheel_omega=history.wheel_speed,
        wheel_sinkage=depth,
        wheel_force=moving.forces.wheels,
        chassis_force=moving.forces.hull,
        steer_angle=jnp.full(2, history.steering),
    )
    return Observation(state.vector, wheel_class, wheels)
