"""A vehicle's numbers from what a person knows or can measure of it.

A description is what `meta.vehicle` of a file of drives may hold; wheels are FL, FR, RL, RR:

    mass, inertia           kg, wheels included; kg m2, [3, 3] about the center of mass
    com_in_body             m, from the middle of the wheel centers at the design position
    wheels_in_body_xy       [4, 2] m
    wheel_radius, _width    m, of all or [4]
    wheel_height_at_rest    [4] m, of the wheel centers in the body
    wheel_load_at_rest      [4] N
    front_angle             rad, of the front wheels at half and at full steering to either side, by
                            "0.5", "1.0", "-0.5" and "-1.0"; full steering is the full angle
    pedal_gain              pedal per m/s of error
    bench                   speeds in m/s every 0.1 s on level ground: `start` from rest to top
                            speed, `stop` from there

and, as far as it is known, `tire_friction` (0.9) and `design`, the numbers of a data sheet:
`wheel_spring` and `wheel_damper` of the front and rear wheels, N/m and N s/m; `wheel_torque` and
`wheel_power` of a driven wheel, N m and W; `brake_torque` of a wheel, N m; `drive`, "awd" or "rwd";
`chassis_box` with `half_length`, `half_width`, `underside` and `roof`, m in the body.
"""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vertiwm_jax.config import ConfigError
from vertiwm_jax.errors import refusing
from vertiwm_jax.mechanics.vehicle import GRAVITY, HMMWV_RADIUS, VehicleConfig

RIDE_FREQUENCY = 2.0
"""Hz, of a quarter of a vehicle on its spring, where spring rates are not known."""
DAMPING = 0.5
"""Share of critical damping of the same, where dampers are not known."""
WHEEL_MASS = 0.0226
"""Mass of a wheel with its tire, as a share of the vehicle's, of an HMMWV."""
WHEEL_INERTIA = 0.9
"""Spin inertia of a wheel with its shafts, as a share of its mass times its radius squared."""
STEERING_SECONDS = 0.1
"""Time from straight ahead to full lock."""
REVERSE = 0.43
"""Torque in reverse as a share of the most forward, of an HMMWV in Chrono, whose engine gives in
reverse at any speed what it gives at rest."""
ONE_AXLE = 0.7
"""Share of what friction lets all wheels give, below which a start is taken for that of a vehicle
whose rear wheels alone are driven, where it is not known which are."""

_KEYS = (
    *("mass", "inertia", "com_in_body", "wheels_in_body_xy", "wheel_radius", "wheel_width"),
    *("wheel_height_at_rest", "wheel_load_at_rest", "front_angle", "pedal_gain", "bench"),
)
_SPAN = 3  # steps of 0.1 s over which accelerations are taken
_SLIPPING = 0.85  # share of friction's acceleration from which on tires set the limit


def is_described(facts: Any) -> bool:
    """Whether what a file says of its vehicle is a description that makes one."""
    return isinstance(facts, Mapping) and all(name in facts for name in _KEYS)


def measured(facts: Mapping[str, Any], where: str) -> VehicleConfig:
    """The vehicle of a description; `ConfigError`, which begins with `where`, if it makes none."""
    with refusing(lambda found: ConfigError(f"{where}: expected a description, found: {found}")):
        try:
            return _measured(facts)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None


def _measured(facts: Mapping[str, Any]) -> VehicleConfig:
    mass, friction = float(facts["mass"]), float(facts.get("tire_friction", 0.9))
    radius = _axles(np.broadcast_to(facts["wheel_radius"], 4))
    places = np.asarray(facts["wheels_in_body_xy"], float)
    wheelbase = places[:2, 0].mean() - places[2:, 0].mean()
    track = places[0::2, 1] - places[1::2, 1]
    wheel_mass, size = WHEEL_MASS * mass, radius.mean()
    spin_inertia, weight = WHEEL_INERTIA * wheel_mass * size**2, wheel_mass * GRAVITY
    design = facts.get("design", {})

    load = _axles(facts["wheel_load_at_rest"])
    sprung = load / GRAVITY - wheel_mass
    spring = np.array(design.get("wheel_spring", sprung * (2 * np.pi * RIDE_FREQUENCY) ** 2))
    damper = np.array(design.get("wheel_damper", 2 * DAMPING * np.sqrt(spring * sprung)))
    free_travel = _axles(facts["wheel_height_at_rest"]) - (load - weight) / spring

    bench = _Bench.of(facts["bench"], friction)
    told = design.get("drive", "rwd" if bench.gained.max() < ONE_AXLE * bench.most else "awd")
    drive: Literal["all", "rear"] = "rear" if "rwd" in told else "all"
    driven, moved = {"all": 4, "rear": 2}[drive], mass + 4 * spin_inertia / size**2
    engine = moved * bench.gained / driven
    # Tires that slip hide how strong an engine or a brake is: an HMMWV's are so by these factors.
    torque = float(design.get("wheel_torque", bench.hidden(2.0) * engine.max() * size))

    angles = facts["front_angle"]
    half, full = (np.mean([abs(angles[side + u]) for side in ("", "-")]) for u in ("0.5", "1.0"))
    box = design.get("chassis_box")
    sides = "half_length", "half_width", "underside", "roof"
    hull = (
        [box[side] for side in sides]
        if box
        else [0.3 * wheelbase, 0.28 * track.mean(), 0, 2 * size]
    )
    return VehicleConfig(
        mass=mass,
        centre_of_mass=_floats(facts["com_in_body"]),
        inertia=_floats(np.diag(facts["inertia"])),
        wheelbase=float(wheelbase),
        track=_floats(track),
        wheel_radius=_floats(radius),
        wheel_width=_floats(_axles(np.broadcast_to(facts["wheel_width"], 4))),
        wheel_inertia=float(spin_inertia),
        wheel_weight=weight,
        spring=_floats(spring),
        damper=_floats(damper),
        free_travel=_floats(free_travel),
        steering_limit=float(full),
        steering_rate=float(full / STEERING_SECONDS),
        speed_gain=float(facts["pedal_gain"]),
        wheel_torque=torque,
        wheel_power=float(
            design.get("wheel_power", bench.hidden(1.25) * (engine * bench.speed).max())
        ),
        wheel_speed_limit=100 * float(HMMWV_RADIUS / size) ** 0.5,
        brake_torque=float(design.get("brake_torque", bench.braking(1.5) * moved * size / 4)),
        tyre_friction=friction,
        hull=_floats(hull),
        length=float(1.4 * wheelbase),
        width=float(1.15 * track.mean()),
        drive=drive,
        wheel_angle=(float(2 * half / full), 1.0),
        reverse_torque=REVERSE * torque,
    )


class _Bench(NamedTuple):
    """Accelerations `[T]` m/s2 in a start, at speeds `[T]` m/s, and `[S]` in a stop.

    most: m/s2 that friction lets all wheels together give.
    """

    gained: np.ndarray
    speed: np.ndarray
    lost: np.ndarray
    most: float

    @classmethod
    def of(cls, bench: Mapping[str, ArrayLike], friction: float) -> "_Bench":
        start, stop = np.append(0.0, bench["start"]), np.asarray(bench["stop"], float)
        gained, lost = ((x[_SPAN:] - x[:-_SPAN]) / (0.1 * _SPAN) for x in (start, -stop))
        return cls(gained, (start[_SPAN:] + start[:-_SPAN]) / 2, lost, friction * GRAVITY)

    def hidden(self, factor: float) -> float:
        """The factor, if tires slipped in the start, else 1."""
        return factor if self.gained.max() > _SLIPPING * self.most else 1.0

    def braking(self, factor: float) -> float:
        """m/s2 of which the brakes are capable: more, by the factor, if tires slipped."""
        return self.lost.max() * (factor if self.lost.max() > _SLIPPING * self.most else 1.0)


def _axles(wheels: ArrayLike) -> np.ndarray:
    """The means `[2]` of the front and of the rear wheels."""
    return np.asarray(wheels, float).reshape(2, 2).mean(axis=1)


def _floats(values: ArrayLike) -> Any:
    return tuple(np.asarray(values, float).tolist())
