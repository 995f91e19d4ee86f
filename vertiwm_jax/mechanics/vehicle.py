"""What a four-wheeled vehicle is: masses, suspension, drivetrain, controller, limits."""

from typing import cast

import jax
import numpy as np
from flax import struct


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


def _vehicle(**values: object) -> Vehicle:
    """NumPy float32 leaves: importing must not start a device."""
    arrays = {name: np.asarray(value, np.float32) for name, value in values.items()}
    return Vehicle(**cast(dict[str, jax.Array], arrays))


def _corners(x: float, y: float) -> list[tuple[float, float]]:
    return [(x, y), (x, -y), (-x, y), (-x, -y)]


def _hull(x: float, y: float, belly: float, roof: float) -> list[tuple[float, float, float]]:
    underside = [(i * x, j * y, belly) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return underside + [(i * x, j * y, roof) for i in (-1, 1) for j in (-1, 1)]


def hmmwv() -> Vehicle:
    """Chrono 9.0.1's HMMWV_Reduced with rigid tyres, as Verti-Bench drives it.

    Masses, geometry and controller are Chrono's. Spring and damper rates at the wheel, torque
    and power were identified from Chrono drives (wheel travel against wheel force; spin-up of
    airborne wheels): the rates of the struts themselves act through linkages.
    """
    return _vehicle(
        mass=2493.6,
        centre_of_mass=(0.0518, 0.0, 0.1838),
        inertia=(1444.9, 4122.4, 5025.8),
        wheel_position=_corners(1.651, 0.910),
        wheel_radius=0.467,
        wheel_width=0.254,
        wheel_inertia=11.0,
        wheel_weight=553.0,
        spring=(147e3, 147e3, 265e3, 265e3),
        damper=(22.4e3, 22.4e3, 28.5e3, 28.5e3),
        free_travel=(0.0249, 0.0249, -0.0186, -0.0186),
        steering_limit=0.3725,
        steering_rate=3.725,
        speed_gain=1.0,
        wheel_torque=6400.0,
        wheel_power=45e3,
        wheel_speed_limit=100.0,
        brake_torque=4000.0,
        tyre_friction=0.9,
        hull=_hull(1.0, 0.5, 0.0, 1.2),
        length=4.6,
        width=2.1,
    )


def rover() -> Vehicle:
    """A 1/10-scale crawler of the Verti-4-Wheeler's kind (Datar et al. 2024): 0.31 m wheelbase.

    Nominal figures for a 3.5 kg rover with stiff tyres; measure your own before relying on them.
    """
    return _vehicle(
        mass=3.5,
        centre_of_mass=(0.0, 0.0, 0.02),
        inertia=(0.02, 0.045, 0.055),
        wheel_position=_corners(0.156, 0.10),
        wheel_radius=0.055,
        wheel_width=0.045,
        wheel_inertia=4e-4,
        wheel_weight=1.5,
        spring=(570.0, 570.0, 570.0, 570.0),
        damper=(20.0, 20.0, 20.0, 20.0),
        free_travel=(-0.0125, -0.0125, -0.0125, -0.0125),
        steering_limit=0.5,
        steering_rate=6.0,
        speed_gain=4.0,
        wheel_torque=0.9,
        wheel_power=12.0,
        wheel_speed_limit=80.0,
        brake_torque=0.9,
        tyre_friction=0.9,
        hull=_hull(0.12, 0.05, 0.0, 0.12),
        length=0.43,
        width=0.25,
    )
