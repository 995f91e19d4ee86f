"""The built-in simulator behind the interface of simulators outside jit."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax import geometry
from vertiwm_jax.learning.dataset import WheelSignals
from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.mechanics.simulator import (
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
_Moving = tuple[VehicleState, SimulatorHistory]


class BuiltIn:
    """A vehicle on the selected world of a map, compiled once for all maps of one size.

    Obstacles are ignored. vehicle: the HMMWV by default.
    """

    def __init__(self, terrain: TerrainMap, vehicle: Vehicle | None = None) -> None:
        self._terrain, self._params = terrain, chrono_like(vehicle or load_vehicle())

    def start(self, x: float, y: float, yaw: float) -> Observation:
        """As `Simulator.start`."""
        pose, none = np.array([x, y, yaw], np.float32), np.zeros(2)
        self._moving = _place(self._params, self._terrain, pose)
        for _ in range(round(SETTLE_SECONDS / STEP_SECONDS) - 1):
            self.step(none)
        return self.step(none)

    def step(self, command: np.ndarray) -> Observation:
        """As `Simulator.step`."""
        command = np.asarray(command, np.float32)
        self._moving, seen = _step(self._params, self._terrain, self._moving, command)
        return jax.device_get(seen)

    def push(self, moved: np.ndarray, pushed: np.ndarray) -> None:
        """Moves the vehicle, `[3]` m, and adds to its velocity, `[3]` m/s, in the world frame."""
        state, history = self._moving
        turned = geometry.rotation_from_rpy(state.rpy).inverse() @ jnp.float32(pushed)
        position, velocity = state.position + jnp.float32(moved), state.velocity + turned
        self._moving = replace(state, position=position, velocity=velocity), history


@jax.jit
def _place(params: SimulatorParams, terrain: TerrainMap, pose: jax.Array) -> _Moving:
    state = place(terrain, pose[:2], pose[2], vehicle=params.vehicle)
    return state, DYNAMICS.init(params, terrain, state)


@jax.jit
def _step(
    params: SimulatorParams, terrain: TerrainMap, moving: _Moving, command: jax.Array
) -> tuple[_Moving, Observation]:
    state, history, forces = DYNAMICS.step_with_forces(
        params, terrain, moving[1], moving[0], Command.from_vector(command)
    )
    vehicle, rotation = params.vehicle, geometry.rotation_from_rpy(state.rpy).as_matrix()
    in_body = jnp.concatenate([vehicle.wheel_position, history.travel[:, None]], axis=-1)
    # Written out: a matmul may round map coordinates to ten bits on an accelerator.
    center = state.position + jnp.sum(rotation * in_body[:, None, :], axis=-1)
    wheel_class, depth = under_wheels(terrain, center, vehicle.wheel_radius)
    wheels = WheelSignals(
        wheel_omega=history.wheel_speed,
        wheel_sinkage=depth,
        wheel_force=jnp.mean(forces.wheels, axis=0),
        chassis_force=jnp.mean(forces.hull, axis=0),
        steer_angle=jnp.full(2, history.steering),
    )
    return (state, history), Observation(state.vector, wheel_class, wheels)
