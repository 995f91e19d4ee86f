"""Kinematic baselines: vehicles without forces."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from flax import struct
from numpy.typing import ArrayLike

from vertiwm_jax import geometry
from vertiwm_jax.mechanics.vehicle import Vehicle, load_vehicle
from vertiwm_jax.precision import float32
from vertiwm_jax.state import STEP_SECONDS, Command, VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap

SPEED_LAG = 0.2
"""s, by which an HMMWV in Chrono follows its commanded speed."""


@dataclass(frozen=True)
class ConstantVelocity:
    """Keeps the body twist: T' = T Exp(nu dt). Ignores command, ground and parameters."""

    @float32
    def init(self, params: None, terrain: TerrainMap, state: VehicleState) -> tuple[()]:
        return ()

    @float32
    def step(
        self,
        params: None,
        terrain: TerrainMap,
        history: tuple[()],
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, tuple[()]]:
        twist = jnp.concatenate([state.velocity, state.angular_velocity], axis=-1)
        position, rpy = geometry.moved(state.position, state.rpy, STEP_SECONDS * twist)
        return replace(state, position=position, rpy=rpy), ()


@struct.dataclass
class BicycleParams:
    """wheelbase and track, m; ride_height of the body origin above the ground, m; speed_lag, s."""

    wheelbase: jax.Array
    track: jax.Array
    ride_height: jax.Array
    speed_lag: jax.Array


@float32
def bicycle_of(vehicle: Vehicle) -> BicycleParams:
    """The bicycle with the axles of `vehicle` that rides as its springs carry it."""
    numbers = vehicle.wheelbase, vehicle.track, vehicle.ride_height, SPEED_LAG
    return BicycleParams(*map(jnp.float32, numbers))


@dataclass(frozen=True)
class KinematicBicycle:
    """A bicycle without slip that follows its commands and lies on the ground under its wheels.

    The speed follows the command with a first-order lag; the steering angle follows at once.
    Height, roll and pitch are those of the plane through the ground at the four wheels.
    """

    @float32
    def init(self, params: BicycleParams, terrain: TerrainMap, state: VehicleState) -> tuple[()]:
        return ()

    @float32
    def step(
        self,
        params: BicycleParams,
        terrain: TerrainMap,
        history: tuple[()],
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, tuple[()]]:
        decay = jnp.exp(-STEP_SECONDS / params.speed_lag)
        speed = command.speed + (state.velocity[0] - command.speed) * decay
        # The rear axle does not slip; the body origin, halfway between the axles, does.
        yaw_rate = speed * jnp.tan(command.steering) / params.wheelbase
        sideways = 0.5 * params.wheelbase * yaw_rate
        side_slip = jnp.arctan(0.5 * jnp.tan(command.steering))
        course = state.rpy[2] + 0.5 * STEP_SECONDS * yaw_rate + side_slip
        # Speed is along the slope; its plan view is shorter.
        level = jnp.cos(state.rpy[1]) * STEP_SECONDS * speed / jnp.cos(side_slip)
        xy = state.position[:2] + level * jnp.stack([jnp.cos(course), jnp.sin(course)])
        yaw = state.rpy[2] + STEP_SECONDS * yaw_rate
        return _driven(terrain, params, state, xy, yaw, (speed, sideways, yaw_rate)), ()


@struct.dataclass
class DifferentialParams:
    """Of a vehicle whose sides turn it, which follows its commands but for slip.

    wheelbase and track, m; ride_height of the body origin above the ground, m.
    speed_gain, turn_gain: `[]` share of the commanded speed and yaw rate that is driven.
    speed_lag, turn_lag: `[]` s, with which they are followed.
    offset: `[]` m, by which the point that does not move sideways lies behind the body origin.
    drift: `[]` s, sideways speed, outwards, per speed and yaw rate.
    """

    wheelbase: jax.Array
    track: jax.Array
    ride_height: jax.Array
    speed_gain: jax.Array
    turn_gain: jax.Array
    speed_lag: jax.Array
    turn_lag: jax.Array
    offset: jax.Array
    drift: jax.Array


@float32
def differential_of(vehicle: Vehicle) -> DifferentialParams:
    """The skid-steered `vehicle` if nothing slipped."""
    skid = vehicle.skid
    assert skid is not None, "front wheels steer it"
    numbers = vehicle.wheelbase, vehicle.track, vehicle.ride_height, skid.gain, skid.gain
    return DifferentialParams(*map(jnp.float32, (*numbers, skid.speed_lag, skid.turn_lag, 0, 0)))


@dataclass(frozen=True)
class DifferentialDrive:
    """A skid-steered vehicle, commanded by speed and yaw rate, that lies on the ground under its
    wheels. Speed and yaw rate follow a share of the commands with first-order lags."""

    @float32
    def init(
        self, params: DifferentialParams, terrain: TerrainMap, state: VehicleState
    ) -> tuple[()]:
        return ()

    @float32
    def step(
        self,
        params: DifferentialParams,
        terrain: TerrainMap,
        history: tuple[()],
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, tuple[()]]:
        def followed(wanted: jax.Array, now: jax.Array, lag: jax.Array) -> jax.Array:
            return wanted + (now - wanted) * jnp.exp(-STEP_SECONDS / lag)

        speed = followed(params.speed_gain * command.speed, state.velocity[0], params.speed_lag)
        turning = state.angular_velocity[2]
        yaw_rate = followed(params.turn_gain * command.steering, turning, params.turn_lag)
        sideways = (params.offset - params.drift * speed) * yaw_rate
        yaw = state.rpy[2] + STEP_SECONDS * yaw_rate
        course = state.rpy[2] + 0.5 * STEP_SECONDS * yaw_rate
        cos, sin = jnp.cos(course), jnp.sin(course)
        # Speed is along the slope; its plan view is shorter.
        ahead, left = jnp.cos(state.rpy[1]) * speed, jnp.cos(state.rpy[0]) * sideways
        moved = jnp.stack([ahead * cos - left * sin, ahead * sin + left * cos])
        xy = state.position[:2] + STEP_SECONDS * moved
        return _driven(terrain, params, state, xy, yaw, (speed, sideways, yaw_rate)), ()


def _driven(
    terrain: TerrainMap,
    params: BicycleParams | DifferentialParams,
    state: VehicleState,
    xy: jax.Array,
    yaw: jax.Array,
    motion: tuple[jax.Array, jax.Array, jax.Array],
) -> VehicleState:
    """The state on the ground at `xy` and `yaw`, after one step.

    motion: `[]` speed ahead and to the left, m/s, and yaw rate, rad/s.
    """
    there = place(terrain, xy, geometry.wrap(yaw), vehicle=params)
    speed, sideways, yaw_rate = motion
    velocity = jnp.stack([speed, sideways, 0.0 * speed])
    tilt_rate = geometry.wrap(there.rpy - state.rpy)[:2] / STEP_SECONDS
    angular_velocity = jnp.concatenate([tilt_rate, yaw_rate[None]])
    return replace(there, velocity=velocity, angular_velocity=angular_velocity)


@float32
def place(
    terrain: TerrainMap,
    xy: ArrayLike | None = None,
    yaw: ArrayLike = 0.0,
    *,
    vehicle: Vehicle | BicycleParams | DifferentialParams | None = None,
    speed: ArrayLike = 0.0,
) -> VehicleState:
    """Places a vehicle on the plane through the ground under its four wheels.

    Args:
        terrain: the map, with the world selected.
        xy: `[2]` m in the frame of the world; the middle of the map by default.
        yaw: heading, rad from x (east) to y (north).
        vehicle: the HMMWV by default. Its origin lies `ride_height` above the plane.
        speed: m/s, forward.

    Returns:
        Its state, leaves `[3]`. A model lets it settle by a few centimeters in its first steps.
    """
    sizes = load_vehicle() if vehicle is None else vehicle
    wheelbase, track = jnp.float32(sizes.wheelbase), jnp.float32(sizes.track)
    if xy is None:
        low, high = terrain.extent
        xy = (low + high) / 2
    xy, yaw = jnp.asarray(xy, jnp.float32), jnp.asarray(yaw, jnp.float32)
    forward = 0.5 * wheelbase * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])
    left = 0.5 * track * jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)])
    wheels = xy + jnp.stack([forward + left, forward - left, -forward + left, -forward - left])
    fl, fr, rl, rr = query.height(terrain, wheels)
    rise = 0.5 * (fl + fr - rl - rr) / wheelbase
    bank = 0.5 * (fl + rl - fr - rr) / track
    pitch = -jnp.arctan(rise)
    roll = jnp.arctan(bank * jnp.cos(pitch))
    above = jnp.float32(sizes.ride_height) * jnp.sqrt(1 + rise**2 + bank**2)
    height = 0.25 * (fl + fr + rl + rr) + above
    velocity = jnp.zeros(3).at[0].set(speed)
    rpy = jnp.stack([roll, pitch, yaw])
    return VehicleState(jnp.append(xy, height), rpy, velocity, jnp.zeros(3))
