"""Turns a command into steering angles, torques and brakes of the wheels."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vertiwm_jax.mechanics.vehicle import GRAVITY, Skid, Vehicle
from vertiwm_jax.state import Command

SHIFT_FROUDE = 0.21
"""Speed over sqrt(g r), r a wheel's radius, below which gears are shifted: 0.45 m/s of an HMMWV."""
SPIN_FLOOR = 0.5
"""Wheel speed, rad/s, below which a locked brake lets a wheel creep."""


class Actuation(NamedTuple):
    """Inputs of the wheels.

    steering: `[]` rad of the front wheels, as far as they have turned, or rad/s of yaw that the
        sides of a skid-steered vehicle are driven to; speed: `[]` m/s that they are, else None.
    angle: `[4]` rad of each wheel.
    gear: `[]` 1 forward, -1 reverse.
    torque: N m on each wheel, `[]` or `[4]`.
    brake: `[4]` N m s/rad, braking torque per wheel speed.
    """

    steering: jax.Array
    speed: jax.Array | None
    angle: jax.Array
    gear: jax.Array
    torque: jax.Array
    brake: jax.Array


def actuate(
    vehicle: Vehicle,
    command: Command,
    forward: jax.Array,
    steering: jax.Array,
    gear: jax.Array,
    wheel_speed: jax.Array,
    seconds: float,
) -> Actuation:
    """The inputs of the wheels for a command in a sub-step. Physics reads commands only here.

    Speed is controlled by a pedal in proportion to its error. A negative speed asks for the reverse
    gear, which is shifted to once the vehicle is nearly at rest; until then it brakes, and likewise
    on the way back to a speed of zero or more. All driven wheels get the same torque, limited by
    power at their mean speed; the engine fades out over the upper half of its speed range. Locked
    differentials then bring wheels to one speed in `simulator`.

    Args:
        forward: `[]` m/s, speed of the vehicle.
        steering: `[]` rad, of the front wheels before; gear: `[]` before, 1 or -1.
        wheel_speed: `[4]` rad/s.
    """
    wanted = jnp.where(command.speed < 0, -1.0, 1.0)
    slow = SHIFT_FROUDE * jnp.sqrt(GRAVITY * jnp.mean(vehicle.wheel_radius))
    gear = jnp.where(jnp.abs(forward) < slow, wanted, gear)
    pedal = jnp.clip(vehicle.speed_gain * (command.speed - forward), -1.0, 1.0)
    pedal = jnp.where(gear == wanted, gear * pedal, -jnp.abs(pedal))
    target = jnp.clip(command.steering, -vehicle.steering_limit, vehicle.steering_limit)
    turn = vehicle.steering_rate * seconds
    steering = steering + jnp.clip(target - steering, -turn, turn)
    angle = steering
    if vehicle.wheel_angle is not None:
        half, full = vehicle.wheel_angle
        share = jnp.abs(steering) / vehicle.steering_limit
        angle = steering * (half + (full - half) * (2 * share - 1))
    driven = vehicle.driven
    mean_speed = jnp.mean(wheel_speed) if driven is None else wheel_speed @ driven / driven.sum()
    mean_speed = jnp.maximum(jnp.abs(mean_speed), 1.0)
    torque = jnp.minimum(vehicle.wheel_torque, vehicle.wheel_power / mean_speed)
    torque = torque * jnp.clip(2 - 2 * mean_speed / vehicle.wheel_speed_limit, 0.0, 1.0)
    if vehicle.reverse_torque is not None:
        own = (gear < 0) & (vehicle.reverse_torque > 0)
        torque = jnp.where(own, vehicle.reverse_torque, torque)
    if driven is not None:
        torque = torque * driven
    brake = vehicle.brake_torque / (jnp.abs(wheel_speed) + SPIN_FLOOR)
    return Actuation(
        steering=steering,
        speed=None,
        angle=jnp.concatenate([jnp.full(2, angle), jnp.zeros(2)]),
        gear=gear,
        torque=gear * jnp.maximum(pedal, 0.0) * torque,
        brake=jnp.maximum(-pedal, 0.0) * brake,
    )


def drive_sides(
    vehicle: Vehicle,
    skid: Skid,
    command: Command,
    steering: jax.Array,
    speed: jax.Array,
    wheel_speed: jax.Array,
    seconds: float,
) -> Actuation:
    """The inputs of the wheels of a skid-steered vehicle, whose command is a speed and a yaw rate.

    Each wheel is driven to the speed that it would roll at, by a pedal in proportion to what it
    lacks. Beyond full pedal, torque and brakes are limited as those of other vehicles.

    Args:
        steering: `[]` rad/s of yaw, and speed: `[]` m/s, that sides were driven to before.
        wheel_speed: `[4]` rad/s.
    """
    target = jnp.clip(command.steering, -vehicle.steering_limit, vehicle.steering_limit)
    turn = vehicle.steering_rate * seconds
    toward = (target - steering) * (1 - jnp.exp(-seconds / skid.turn_lag))
    steering = steering + jnp.clip(toward, -turn, turn)
    speed = speed + (command.speed - speed) * (1 - jnp.exp(-seconds / skid.speed_lag))
    radius, left = vehicle.wheel_radius, vehicle.wheel_position[:, 1]
    limit = vehicle.wheel_speed_limit
    rolling = jnp.clip(skid.gain * (speed - steering * left) / radius, -limit, limit)
    missing = rolling - wheel_speed
    torque = jnp.minimum(
        vehicle.wheel_torque, vehicle.wheel_power / jnp.maximum(jnp.abs(wheel_speed), 1.0)
    )
    torque = jnp.where(missing * wheel_speed < 0, vehicle.brake_torque, torque)
    per_speed = vehicle.speed_gain * radius
    # As a damper about the speed to be driven, which the integrator takes implicitly.
    damper = torque * per_speed / jnp.maximum(per_speed * jnp.abs(missing), 1.0)
    return Actuation(
        steering=steering,
        speed=speed,
        angle=jnp.zeros(4),
        gear=jnp.where(speed < 0, -1.0, 1.0),
        torque=damper * rolling,
        brake=damper,
    )
