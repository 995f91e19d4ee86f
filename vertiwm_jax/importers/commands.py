"""Commands of logs, however they were given, as a speed and a front-wheel angle or a yaw rate."""

from typing import Literal

import numpy as np

from vertiwm_jax.importers.settings import VehicleSettings

Kind = Literal["steering", "yaw_rate", "wheels"]
"""Speed and front-wheel angle, speed and yaw rate, or speeds of the left and the right wheels."""
_SLOWEST = 0.05  # m/s at full size
_FARTHEST = np.radians(45)


def of_vehicle(command: np.ndarray, kind: Kind, vehicle: VehicleSettings) -> np.ndarray:
    """`[M, 2]` commands in SI units to those of drives: m/s, and the angle of front wheels, rad, or
    the yaw rate of a skid-steered vehicle, rad/s."""
    speed, turn = command[:, 0], command[:, 1]
    if kind == "wheels":
        speed, turn = differential(speed, turn, vehicle.track)
    if vehicle.steered == "skid":
        yaw_rate = speed * np.tan(turn) / vehicle.wheelbase if kind == "steering" else turn
        return np.stack([speed, yaw_rate], axis=1)
    if kind == "steering":
        return command
    slowest = _SLOWEST / vehicle.scale**0.5
    return np.stack([speed, steering(speed, turn, vehicle.wheelbase, slowest)], axis=1)


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
