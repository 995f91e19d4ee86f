"""What a four-wheeled vehicle is: masses, suspension, drivetrain, controller, limits."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import cast

import jax
import numpy as np
from flax import struct

from vertiwm_jax import config as configuration

GRAVITY = 9.81
HMMWV = "hmmwv"
"""The name of the vehicle that drives unless another is chosen."""


@struct.dataclass
class Vehicle:
    """A vehicle with independent suspension and all-wheel drive; SI units, body axes.

    Wheels are front-left, front-right, rear-left, rear-right. The body origin lies between the
    wheel centres of the design position.

    mass: `[]` kg, wheels included.
    centre_of_mass: `[3]` m.
    inertia: `[3]` kg m2, principal moments about the centre of mass.
    wheel_position: `[4, 2]` x, y of the wheel centres, m.
    wheel_radius, wheel_width: `[]` m.
    wheel_inertia: `[]` kg m2 about the axle.
    wheel_weight: `[]` N, what pulls an airborne wheel down.
    spring: `[4]` N/m at the wheel.
    damper: `[4]` N s/m at the wheel.
    free_travel: `[4]` m, wheel height in the body at which the spring is relaxed.
    steering_limit: `[]` rad; steering_rate: `[]` rad/s, both at the front wheels.
    speed_gain: `[]` s/m, pedal per speed error; full pedal is 1.
    wheel_torque: `[]` N m a wheel at full throttle; wheel_power: `[]` W a wheel at most.
    wheel_speed_limit: `[]` rad/s, mean wheel speed beyond which the engine gives nothing.
    brake_torque: `[]` N m a wheel at full braking.
    tyre_friction: `[]` the tyre's own friction coefficient; contact takes the smaller one.
    hull: `[P, 3]` m, points of the chassis that touch the ground first, underside and roof.
    length, width: `[]` m, the rectangle that collides with obstacles, centred on the origin.
    """

    mass: jax.Array
    centre_of_mass: jax.Array
    inertia: jax.Array
    wheel_position: jax.Array
    wheel_radius: jax.Array
    wheel_width: jax.Array
    wheel_inertia: jax.Array
    wheel_weight: jax.Array
    spring: jax.Array
    damper: jax.Array
    free_travel: jax.Array
    steering_limit: jax.Array
    steering_rate: jax.Array
    speed_gain: jax.Array
    wheel_torque: jax.Array
    wheel_power: jax.Array
    wheel_speed_limit: jax.Array
    brake_torque: jax.Array
    tyre_friction: jax.Array
    hull: jax.Array
    length: jax.Array
    width: jax.Array

    @property
    def wheelbase(self) -> jax.Array:
        """`[]` m between the axles."""
        return self.wheel_position[0, 0] - self.wheel_position[2, 0]

    @property
    def track(self) -> jax.Array:
        """`[]` m between left and right wheels."""
        return self.wheel_position[0, 1] - self.wheel_position[1, 1]

    @property
    def travel_at_rest(self) -> jax.Array:
        """`[4]` m, height of the wheel centres in the body where the springs carry the weight."""
        load = self.mass * GRAVITY / 4
        return self.free_travel + (load - self.wheel_weight) / self.spring


@dataclass(frozen=True)
class VehicleConfig:
    """The numbers of a vehicle, SI units, as a file in `configs/vehicles` holds them.

    Axes and fields are those of `Vehicle`; left and right are alike, pairs are front and rear.
    """

    mass: float
    """kg, wheels included."""
    centre_of_mass: tuple[float, float, float]
    """m in the body, whose origin lies between the wheel centres of the design position."""
    inertia: tuple[float, float, float]
    """kg m2, principal moments about the centre of mass."""
    wheelbase: float
    """m between the axles."""
    track: float
    """m between left and right wheels."""
    wheel_radius: float
    """m."""
    wheel_width: float
    """m."""
    wheel_inertia: float
    """kg m2 about the axle."""
    wheel_weight: float
    """N, what pulls an airborne wheel down."""
    spring: tuple[float, float]
    """N/m at the wheel."""
    damper: tuple[float, float]
    """N s/m at the wheel."""
    free_travel: tuple[float, float]
    """m, wheel height in the body at which the spring is relaxed."""
    steering_limit: float
    """rad at the front wheels."""
    steering_rate: float
    """rad/s at the front wheels."""
    speed_gain: float
    """s/m, pedal per speed error; full pedal is 1."""
    wheel_torque: float
    """N m a wheel at full throttle."""
    wheel_power: float
    """W a wheel at most."""
    wheel_speed_limit: float
    """rad/s, mean wheel speed beyond which the engine gives nothing."""
    brake_torque: float
    """N m a wheel at full braking."""
    tyre_friction: float
    """The tyre's own friction coefficient; contact takes the smaller one."""
    hull: tuple[float, float, float, float]
    """The chassis as a box, m: half its length, half its width, height of underside and roof."""
    length: float
    """m, of the rectangle that collides with obstacles."""
    width: float
    """m, of that rectangle."""
    scale: float = 1.0
    """m at full size that 1 m of the vehicle is: about 10 for a 1/10-scale rover, so that it is as
    large as an HMMWV there."""

    def __post_init__(self) -> None:
        signed = ("centre_of_mass", "free_travel", "hull")
        for name, value in vars(self).items():
            numbers = np.atleast_1d(value)
            if not np.isfinite(numbers).all():
                raise ValueError(f"{name}: expected finite numbers, found {value}")
            if name not in signed and not (numbers > 0).all():
                raise ValueError(f"{name}: expected > 0, found {value}")
        x, y, belly, roof = self.hull
        if not (x > 0 and y > 0 and belly < roof):
            raise ValueError(
                f"hull: expected half the length and half the width, > 0, and an underside below "
                f"the roof, found {self.hull}"
            )
        first, second, third = sorted(self.inertia)
        if third > first + second:
            raise ValueError(
                f"inertia: expected no moment larger than the sum of both others, "
                f"found {self.inertia}"
            )

    @property
    def vehicle(self) -> Vehicle:
        """At full size, by Froude's similarity; NumPy float32 leaves, which start no device.

        Lengths are `scale` times those of the vehicle, times and speeds its root: gravity, slopes,
        friction and density stay as they are, so the motion is the same but for its scale.
        """
        metre, second = self.scale, self.scale**0.5
        kilogram = metre**3
        newton = kilogram * metre / second**2
        x, y = self.wheelbase / 2, self.track / 2
        values = {
            "mass": self.mass * kilogram,
            "centre_of_mass": np.multiply(self.centre_of_mass, metre),
            "inertia": np.multiply(self.inertia, kilogram * metre**2),
            "wheel_position": np.multiply([(x, y), (x, -y), (-x, y), (-x, -y)], metre),
            "wheel_radius": self.wheel_radius * metre,
            "wheel_width": self.wheel_width * metre,
            "wheel_inertia": self.wheel_inertia * kilogram * metre**2,
            "wheel_weight": self.wheel_weight * newton,
            "spring": np.repeat(self.spring, 2) * newton / metre,
            "damper": np.repeat(self.damper, 2) * newton * second / metre,
            "free_travel": np.repeat(self.free_travel, 2) * metre,
            "steering_limit": self.steering_limit,
            "steering_rate": self.steering_rate / second,
            "speed_gain": self.speed_gain * second / metre,
            "wheel_torque": self.wheel_torque * newton * metre,
            "wheel_power": self.wheel_power * newton * metre / second,
            "wheel_speed_limit": self.wheel_speed_limit / second,
            "brake_torque": self.brake_torque * newton * metre,
            "tyre_friction": self.tyre_friction,
            "hull": np.multiply(_box(*self.hull), metre),
            "length": self.length * metre,
            "width": self.width * metre,
        }
        arrays = {name: np.asarray(value, np.float32) for name, value in values.items()}
        return Vehicle(**cast(dict[str, jax.Array], arrays))


def load(name: str) -> VehicleConfig:
    """The vehicle of that name among those that come with the package, or in a YAML file.

    name: a file's ends in .yaml or .yml. Raises `ConfigError`, which names file and field.
    """
    of_file = name.endswith((".yaml", ".yml"))
    path = Path(name) if of_file else configuration.default_config(f"vehicles/{name}")
    return configuration.load(VehicleConfig, path)


@cache
def hmmwv() -> Vehicle:
    """Chrono's HMMWV, which the model that comes with the package knows."""
    return load(HMMWV).vehicle


def _box(x: float, y: float, belly: float, roof: float) -> list[tuple[float, float, float]]:
    """Points of the chassis: nine below, four above."""
    underside = [(i * x, j * y, belly) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return underside + [(i * x, j * y, roof) for i in (-1, 1) for j in (-1, 1)]
