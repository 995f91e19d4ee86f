"""What specialists read of the vehicle itself, in numbers that do not depend on its size."""

import jax
import jax.numpy as jnp

from vertiwm_jax.mechanics.vehicle import GRAVITY, Vehicle, load_vehicle

SIZE = 26
"""Numbers of a vehicle."""
MOST = 2.0
"""Where features are cut off: of vehicles that differ more from the HMMWV, little is known."""


def described(vehicle: Vehicle) -> jax.Array:
    """`[SIZE]` how a vehicle differs from the HMMWV, which is all zeros; e-fold changes are 1.

    By Froude: lengths by a wheel's radius, forces by the weight, times by sqrt(radius / gravity).
    The radius itself comes last.
    """
    return jnp.clip(_numbers(vehicle) - _numbers(load_vehicle()), -MOST, MOST)


def _numbers(vehicle: Vehicle) -> jax.Array:
    radius = jnp.mean(vehicle.wheel_radius)
    weight, time = vehicle.mass * GRAVITY, jnp.sqrt(radius / GRAVITY)
    positive = [
        vehicle.wheelbase / radius,
        vehicle.track / radius,
        jnp.mean(vehicle.wheel_width) / radius,
        vehicle.mass / radius**3,
        vehicle.inertia / (vehicle.mass * radius**2),
        vehicle.spring[::2] * radius / weight,
        vehicle.damper[::2] * radius / (weight * time),
        vehicle.steering_limit,
        vehicle.steering_rate * time,
        vehicle.speed_gain * radius / time,
        vehicle.wheel_torque / (weight * radius),
        vehicle.wheel_power * time / (weight * radius),
        vehicle.brake_torque / (weight * radius),
        vehicle.tyre_friction,
        radius,
    ]
    driven = jnp.ones(4) if vehicle.driven is None else vehicle.driven
    locked = jnp.zeros(4) if vehicle.locked is None else vehicle.locked
    signed = [
        jnp.mean(driven[:2]) - jnp.mean(driven[2:]),
        jnp.mean(locked),
        vehicle.centre_of_mass[::2] / radius,
        vehicle.ride_height / radius,
        jnp.min(vehicle.hull[:, 2]) / radius,
        jnp.max(vehicle.hull[:, 0]) / radius,
    ]
    both = [jnp.concatenate([jnp.ravel(x) for x in group]) for group in (signed, positive)]
    return jnp.concatenate([both[0], jnp.log(both[1])])
