"""Commands of logs, however they were given, as a speed and a front-wheel angle."""

from typing import Literal

import numpy as np

from vertiwm_jax.importers.settings import VehicleSettings

Kind = Literal["steering", "yaw_rate", "wheels"]
"""Speed and front-wheel angle, speed and yaw rate, or speeds of the left and the right wheels."""
_SLOWEST = 0.05  # m/s at full size
_FARTHEST = np.radians(45)
_TIGHTEST = np.tan(np.radians(80))


def of_bicycle(command: np.ndarray, kind: Kind, vehicle: VehicleSettings) -> np.ndarray:
    """`[M, 2]` commands in SI units to `[M, 2]` m/s and rad, NaN where no angle turns like that."""
    if kind == "steering":
        return command
    speed, yaw_rate = command[:, 0], command[:, 1]
    if kind == "wheels":
        speed, yaw_rate = differential(speed, yaw_rate, vehicle.track)
    angle_of = skidding if vehicle.steered == "skid" else steering
    slowest = _SLOWEST / vehicle.scale**0.5
    return np.stack([speed, angle_of(speed, yaw_rate, vehicle.wheelbase, slowest)], axis=1)


def differential(
    left: np.ndarray, right: np.ndarray, track: float
) -> tuple[np.ndarray, np.ndarray]:
    """`[M]` m/s of the wheels of both sides to the `[M]` m/s and rad/s at which they drive."""
    return (left + right) / 2, (right - left) / track


def steering(
    speed: np.ndarray, yaw_rate: np.ndarray, wheelbase: float, slowest: float = _SLOWEST
) -> np.ndarray:
    """`[M]` m/s and rad/s to the `[M]` front-wheel angles, rad, that turn so without slip.

    No wheel turns beyond `_FARTHEST`. At next to no speed a yaw rate gives no angle: the wheels
    keep theirs, and are straight at first.
    """
    moving = np.abs(speed) >= slowest
    angle = np.arctan(wheelbase * yaw_rate / np.where(moving, speed, 1))
    angle = np.clip(angle, -_FARTHEST, _FARTHEST)
    latest = np.maximum.accumulate(np.where(moving, np.arange(len(speed)), -1))
    return np.where(latest >= 0, angle[latest], 0)


def skidding(
    speed: np.ndarray, yaw_rate: np.ndarray, wheelbase: float, slowest: float = _SLOWEST
) -> np.ndarray:
    """`[M]` m/s and rad/s to the `[M]` angles, rad, of a bicycle that turns as a skid-steered
    vehicle does; NaN where that turns on the spot, or nearly so."""
    around = wheelbase * yaw_rate
    standing = (np.abs(speed) < slowest) & (np.abs(around) < slowest)
    held = standing | (np.abs(around) <= _TIGHTEST * np.abs(speed))
    return np.where(
        held, np.arctan(np.where(standing, 0, around) / np.where(speed, speed, 1)), np.nan
    )
