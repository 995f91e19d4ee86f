"""How each quantity of a vehicle and of its ground grows with their size.

Froude similarity: if lengths grow by a factor and times by its square root, then gravity, slopes,
friction and density stay the same, and the motion is the same at another scale.
"""

from dataclasses import is_dataclass, replace
from typing import Any, TypeVar, cast

Quantities = TypeVar("Quantities")

POWER: dict[str, float] = {
    # Of a vehicle.
    "mass": 3, "centre_of_mass": 1, "inertia": 5, "wheel_position": 1, "wheel_radius": 1,
    "wheel_width": 1, "wheel_inertia": 5, "wheel_weight": 3, "spring": 2, "damper": 2.5,
    "free_travel": 1, "steering_limit": 0, "steering_rate": -0.5, "speed_gain": -0.5,
    "wheel_torque": 4, "wheel_power": 3.5, "wheel_speed_limit": -0.5, "brake_torque": 4,
    "tyre_friction": 0, "hull": 1, "length": 1, "width": 1, "driven": 0, "locked": 0,
    "wheel_angle": 0, "reverse_torque": 4,
    "gain": 0, "speed_lag": 0.5, "turn_lag": 0.5, "slip_speed": 0.5,
    # Of a soil: its stresses grow as its depths do. For Bekker's moduli see `scaled`.
    "cohesion": 1, "shear_modulus": 1,
    # Of a map.
    "elevation": 1, "obstacles": 1, "origin": 1, "resolution": 1, "middles": 1,
}  # fmt: skip
"""The power of the factor by which each quantity grows."""


def scaled(quantities: Quantities, factor: float) -> Quantities:
    """The same vehicle, soil or map, `factor` times as large; the soils of a map are scaled too."""
    if factor == 1:
        return quantities
    changes = {}
    for name, value in vars(quantities).items():
        if is_dataclass(value):
            changes[name] = scaled(value, factor)
        elif name in ("kc", "kphi"):  # Pressure is (kc / width + kphi) depth^n.
            power = (2 if name == "kc" else 1) - vars(quantities)["n"]
            changes[name] = value * factor**power
        elif name in POWER and value is not None:
            changes[name] = _times(value, factor ** POWER[name])
    return replace(cast(Any, quantities), **changes)


def _times(value: Any, factor: float) -> Any:
    """A number, an array, or a tuple of such, times the factor."""
    if isinstance(value, tuple):
        return tuple(_times(x, factor) for x in value)
    return value * factor
