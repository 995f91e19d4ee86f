"""The shape of a vehicle and how it steers, as far as an environment must know it."""

from dataclasses import dataclass
from typing import Self

from vertiwm_jax.mechanics.vehicle import Vehicle


@dataclass(frozen=True)
class Chassis:
    """What an environment must know of the vehicle, in m; the HMMWV by default.

    length, width: the rectangle that must stay clear of obstacles.
    wheelbase, track: where the wheels touch the ground.
    axle_height: of the body origin above level ground.
    steering_limit: largest angle of the front wheels, rad.
    """

    length: float = 4.6
    width: float = 2.2
    wheelbase: float = 3.378
    track: float = 1.82
    axle_height: float = 0.47
    steering_limit: float = 0.3725

    @classmethod
    def of(cls, vehicle: Vehicle) -> Self:
        """That of a vehicle on its relaxed springs, or nearly so."""
        sizes = vehicle.length, vehicle.width, vehicle.wheelbase, vehicle.track
        return cls(
            *map(float, sizes),
            axle_height=float(vehicle.wheel_radius),
            steering_limit=float(vehicle.steering_limit),
        )
