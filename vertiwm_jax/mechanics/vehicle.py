"""A four-wheeled vehicle: masses, suspension, drivetrain, speed controller and limits."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax import config as configuration
from vertiwm_jax import froude
from vertiwm_jax.config import ConfigError, Positive, settings
from vertiwm_jax.errors import UserError
from vertiwm_jax.precision import float32
from vertiwm_jax.state import STEP_SECONDS, Command, Turn
from vertiwm_jax.terrain.patches import PATCH_METERS

GRAVITY = 9.81
HMMWV = "hmmwv"
"""Name of the default vehicle."""
HMMWV_RADIUS = 0.467
"""m, of its wheels."""
_WHEELS = 0.15, 1.5
"""m, radius at full size, for which time steps, patches and tasks are made."""
_SEEN = PATCH_METERS / 2 - 8.0 * STEP_SECONDS
"""m about a vehicle that a patch still covers when it has moved for a step, at 8 m/s."""
_AXLES = {"all": (1, 1, 1, 1), "rear": (0, 0, 1, 1), "front": (1, 1, 0, 0), "none": (0, 0, 0, 0)}


@struct.dataclass
class Skid:
    """How a skid-steered vehicle, whose wheels do not turn, follows commands; each `[]`.

    gain: speed that the wheels are driven to, as a share of the commanded one.
    speed_lag, turn_lag: s, with which speed and yaw rate that wheels are driven to follow commands.
    slip_speed: m/s at which friction of the tires reaches 71 % of its limit.
    """

    gain: jax.Array
    speed_lag: jax.Array
    turn_lag: jax.Array
    slip_speed: jax.Array


@struct.dataclass
class Vehicle:
    """A vehicle with independent suspension; SI units, body axes.

    Wheels are front-left, front-right, rear-left, rear-right. The body origin lies between the
    wheel centers of the design position. What is `[]` of a wheel may be `[4]`.

    mass: `[]` kg, wheels included.
    centre_of_mass: `[3]` m.
    inertia: `[3]` kg m2, principal moments about the center of mass.
    wheel_position: `[4, 2]` x, y of the wheel centers, m.
    wheel_radius, wheel_width: `[]` m.
    wheel_inertia: `[]` kg m2 about the axle.
    wheel_weight: `[]` N, pulls an airborne wheel down.
    spring: `[4]` N/m at the wheel.
    damper: `[4]` N s/m at the wheel.
    free_travel: `[4]` m, wheel height in the body at which the spring is relaxed.
    steering_limit: `[]` rad; steering_rate: `[]` rad/s, both at the front wheels.
    speed_gain: `[]` s/m, pedal per speed error; full pedal is 1.
    wheel_torque: `[]` N m a driven wheel at full throttle; wheel_power: `[]` W a driven wheel at
        most.
    wheel_speed_limit: `[]` rad/s, mean speed of the driven wheels beyond which the engine gives
        nothing.
    brake_torque: `[]` N m a wheel at full braking.
    tyre_friction: `[]` the tire's own friction coefficient; contact takes the smaller one.
    hull: `[P, 3]` m, points of the chassis that touch the ground first, underside and roof.
    length, width: `[]` m, the rectangle that collides with obstacles, centered on the origin.
    skid: of a skid-steered vehicle: `steering_limit` and `steering_rate` are then rad/s and rad/s2
        of the yaw rate that it is told. None: the front wheels steer.
    driven: `[4]`, 1 of wheels that the engine drives, else 0; None: it drives all.
    locked: `[4]`, 1 of wheels that locked differentials bring to one speed, else 0; None: all
        differentials are open.
    wheel_angle: `[2]`, angle of the front wheels as a share of the commanded one, at half and at
        full lock, linear in the angle; None: they turn as commanded.
    reverse_torque: `[]` N m a driven wheel in reverse gear, at any speed; None, or 0 of stacked
        vehicles: as forward.
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
    driven: jax.Array | None = None
    locked: jax.Array | None = None
    wheel_angle: jax.Array | None = None
    reverse_torque: jax.Array | None = None
    skid: Skid | None = None

    @property
    def wheelbase(self) -> jax.Array:
        """`[]` m between the axles."""
        return self.wheel_position[0, 0] - self.wheel_position[2, 0]

    @property
    def turn(self) -> Turn:
        """What the second of its commands is."""
        return "steering" if self.skid is None else "yaw_rate"

    @property
    def track(self) -> jax.Array:
        """`[]` m between left and right wheels, the mean of both axles."""
        left, right = self.wheel_position[0::2, 1], self.wheel_position[1::2, 1]
        return (left - right).mean()

    @property
    def ride_height(self) -> jax.Array:
        """`[]` m from level ground to the body origin of a vehicle that stands on its springs."""
        return self.wheel_radius.mean() - self.travel_at_rest.mean()

    @property
    def travel_at_rest(self) -> jax.Array:
        """`[4]` m, height of the wheel centers in the body where the springs carry the weight."""
        load = self.mass * GRAVITY / 4
        return self.free_travel + (load - self.wheel_weight) / self.spring

    def command(self, action: jax.Array, speed_range: tuple[float, float]) -> Command:
        """The command that `[..., 2]` actions in [-1, 1], clipped to that, stand for.

        speed_range: commanded speed in m/s at actions -1 and 1.
        """
        action = jnp.clip(action, -1.0, 1.0)
        low, high = speed_range
        speed = low + (action[..., 0] + 1) / 2 * (high - low)
        return Command(speed, action[..., 1] * self.steering_limit)

    def action(self, command: Command, speed_range: tuple[float, float]) -> jax.Array:
        """The `[..., 2]` action of a command, clipped to [-1, 1]; the inverse of `command`."""
        low, high = speed_range
        speed = (command.speed - low) / (high - low) * 2 - 1
        return jnp.clip(jnp.stack([speed, command.steering / self.steering_limit], -1), -1.0, 1.0)

    @property
    def fastest(self) -> jax.Array:
        """`[]` m/s, beyond which the engine does not turn the wheels."""
        return self.wheel_speed_limit * self.wheel_radius.mean()

    def select(self, which: jax.Array) -> "Vehicle":
        """One of stacked vehicles, by its number `[]`."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[which], self)

    def curvature(self, steering: jax.Array | np.ndarray) -> jax.Array:
        """`[...]` 1/m of the arcs driven at a steering in [-1, 1], left positive; those of a
        skid-steered vehicle at the largest speed of its wheels."""
        if self.skid is not None:
            return self.steering_limit * steering / self.fastest
        return jnp.tan(self.steering_limit * steering) / self.wheelbase


@settings
class SkidConfig:
    """How a skid-steered vehicle follows commands; as in `Skid`."""

    gain: Positive = 1.0
    """Speed that the wheels are driven to, as a share of the commanded one."""
    speed_lag: Positive = 0.1
    """s, with which the speed that the wheels are driven to follows the commanded one."""
    turn_lag: Positive = 0.1
    """s, the same of the yaw rate."""
    slip_speed: Positive = 0.1
    """m/s of slip at which friction of the tires reaches 71 % of its limit."""

    def check(self) -> None:
        _expect_finite(self)


@settings
class VehicleConfig:
    """The numbers of a vehicle in SI units, as in a file of `configs/vehicles`.

    Axes and fields are those of `Vehicle`. Left and right are equal; pairs are front and rear, and
    one number stands for a pair of equals.
    """

    mass: Positive
    """kg, wheels included."""
    centre_of_mass: tuple[float, float, float]
    """m in the body, whose origin lies between the wheel centers of the design position."""
    inertia: tuple[Positive, Positive, Positive]
    """kg m2, principal moments about the center of mass."""
    wheelbase: Positive
    """m between the axles."""
    track: Positive | tuple[Positive, Positive]
    """m between left and right wheels."""
    wheel_radius: Positive | tuple[Positive, Positive]
    """m."""
    wheel_width: Positive | tuple[Positive, Positive]
    """m."""
    wheel_inertia: Positive
    """kg m2 about the axle."""
    wheel_weight: Positive
    """N, pulls an airborne wheel down."""
    spring: tuple[Positive, Positive]
    """N/m at the wheel."""
    damper: tuple[Positive, Positive]
    """N s/m at the wheel."""
    free_travel: tuple[float, float]
    """m, wheel height in the body at which the spring is relaxed."""
    steering_limit: Positive
    """rad at the front wheels; rad/s of yaw of a skid-steered vehicle."""
    steering_rate: Positive
    """rad/s at the front wheels; rad/s2 of yaw of a skid-steered vehicle."""
    speed_gain: Positive
    """s/m, pedal per speed error; full pedal is 1."""
    wheel_torque: Positive
    """N m a driven wheel at full throttle."""
    wheel_power: Positive
    """W a driven wheel at most."""
    wheel_speed_limit: Positive
    """rad/s, mean speed of the driven wheels beyond which the engine gives nothing."""
    brake_torque: Positive
    """N m a wheel at full braking."""
    tyre_friction: Positive
    """The tire's own friction coefficient; contact takes the smaller one."""
    hull: tuple[float, float, float, float]
    """The chassis as a box, m: half its length, half its width, height of underside and roof."""
    length: Positive
    """m, of the rectangle that collides with obstacles."""
    width: Positive
    """m, of that rectangle."""
    drive: Literal["all", "rear", "front"] = "all"
    """The axles whose wheels the engine drives."""
    locked: Literal["none", "rear", "front", "all"] = "none"
    """The axles whose wheels locked differentials bring to one speed; others have open ones."""
    wheel_angle: tuple[Positive, Positive] = (1.0, 1.0)
    """Angle of the front wheels as a share of the commanded one, at half and at full lock."""
    reverse_torque: Positive | None = None
    """N m a driven wheel in reverse gear, at any speed; null: as forward."""
    skid: SkidConfig | None = None
    """Of a skid-steered vehicle: no wheel turns, and its sides are driven to the speeds of the
    commanded speed and yaw rate. Without it, the front wheels steer."""
    scale: Positive = 1.0
    """The factor to HMMWV size: 10 for a 1/10-scale rover."""

    def check(self) -> None:
        _expect_finite(self)
        x, y, belly, roof = self.hull
        if not (x > 0 and y > 0 and belly < roof):
            expected = "half the length and half the width, > 0, and an underside below the roof"
            raise ValueError(f"hull: expected {expected}, found {self.hull}")
        first, second, third = sorted(self.inertia)
        if third > first + second:
            expected = "no moment larger than the sum of both others"
            raise ValueError(f"inertia: expected {expected}, found {self.inertia}")
        if self.drive != "all" and self.locked not in ("none", self.drive):
            expected = f"none or {self.drive}, as these wheels are driven"
            raise ValueError(f"locked: expected {expected}, found {self.locked!r}")
        if self.skid and (self.drive, self.locked) != ("all", "none"):
            expected = "drive: all and locked: none of a skid-steered vehicle"
            raise ValueError(f"skid: expected {expected}, found {self.drive} and {self.locked}")

    @property
    def turn(self) -> Turn:
        """What the second of its commands is."""
        return "yaw_rate" if self.skid else "steering"

    @property
    def vehicle(self) -> Vehicle:
        """At full size, by Froude's similarity; NumPy float32 leaves, which start no device."""
        x, y = self.wheelbase / 2, np.broadcast_to(self.track, 2) / 2
        values: dict[str, Any] = dict(vars(self))
        for name in ("wheel_radius", "wheel_width", "spring", "damper", "free_travel"):
            if isinstance(values[name], tuple):
                values[name] = np.repeat(values[name], 2)
        values |= {
            "wheel_position": [(x, y[0]), (x, -y[0]), (-x, y[1]), (-x, -y[1])],
            "hull": _box(*self.hull),
            "driven": None if self.drive == "all" else _AXLES[self.drive],
            "locked": None if self.locked == "none" else _AXLES[self.locked],
            "wheel_angle": None if self.wheel_angle == (1, 1) else self.wheel_angle,
            "skid": self.skid and Skid(**vars(self.skid)),
        }
        if self.skid:  # Rates of angles, which do not grow with size.
            second = self.scale**0.5
            values |= {name: values[name] / second for name in ("steering_limit", "steering_rate")}
        given = {field.name: values[field.name] for field in fields(Vehicle)}
        arrays = {
            name: value if value is None or name == "skid" else np.asarray(value, float)
            for name, value in given.items()
        }
        large = froude.scaled(Vehicle(**cast(dict[str, Any], arrays)), self.scale)
        return jax.tree.map(lambda x: np.asarray(x, np.float32), large)


def equal(first: Vehicle, second: Vehicle) -> bool:
    """Whether two vehicles have the same numbers."""
    if jax.tree.structure(first) != jax.tree.structure(second):
        return False
    return jax.tree.all(jax.tree.map(np.array_equal, first, second))


def stack(vehicles: Sequence[Vehicle]) -> Vehicle:
    """Vehicles of any layouts as one with leaves `[N, ...]`, for `select`.

    Raises `UserError` for skid-steered vehicles among others.
    """
    every = [vars(vehicle) for vehicle in vehicles]
    plain = {
        **{"driven": _AXLES["all"], "locked": _AXLES["none"]},
        **{"wheel_angle": (1, 1), "reverse_torque": 0},
    }
    leaves: dict[str, Any] = {}
    skids = [vehicle.skid for vehicle in vehicles if vehicle.skid is not None]
    if skids:
        if len(skids) < len(vehicles):
            raise UserError("vehicles: expected skid-steered ones alone, or none among others")
        leaves["skid"] = jax.tree.map(lambda *leaf: np.stack(leaf), *skids)
    for name in every[0].keys() - {"skid"}:
        given = [numbers[name] for numbers in every]
        if any(x is not None for x in given):
            filled = [np.array(plain[name], np.float32) if x is None else x for x in given]
            leaves[name] = np.stack(np.broadcast_arrays(*filled))
    return Vehicle(**leaves)


def load(name: str) -> VehicleConfig:
    """The vehicle of that name among those that come with the package, or in a YAML file.

    name: a file's ends in .yaml or .yml. Raises `ConfigError`, which names file and field.
    """
    of_file = name.endswith((".yaml", ".yml"))
    path = Path(name) if of_file else configuration.default_config(f"vehicles/{name}")
    found = configuration.load(VehicleConfig, path)
    wheel, reach = np.max(found.wheel_radius), np.hypot(found.length, found.width) / 2
    least, most = _WHEELS
    if not least <= found.scale * wheel <= most:
        raise ConfigError(
            f"{path}: scale: expected about {HMMWV_RADIUS / wheel:.2g}, by which wheels become as "
            f"large as an HMMWV's, found {found.scale:g}"
        )
    if found.scale * reach > _SEEN:
        raise ConfigError(
            f"{path}: length: expected corners within {_SEEN / found.scale:.2g} m of the middle, "
            f"as models see no farther, found {reach:.2g} m"
        )
    return found


@float32
def load_vehicle(name: str = HMMWV) -> Vehicle:
    """Loads a vehicle.

    Args:
        name: of a shipped one (`hmmwv`, `rover`, ...), or a YAML file of one. The HMMWV of
            Chrono, which the shipped model is fitted to, by default.

    Returns:
        Its numbers at full size, in SI units, in the body frame: x forward, y left, z up.

    Raises:
        ConfigError: there is no such vehicle, or its file is malformed.
    """
    return load(name).vehicle


def _expect_finite(numbers: VehicleConfig | SkidConfig) -> None:
    for name, value in vars(numbers).items():
        told = value is None or isinstance(value, str | SkidConfig)
        if not told and not np.isfinite(value).all():
            raise ValueError(f"{name}: expected finite numbers, found {value}")


def _box(x: float, y: float, belly: float, roof: float) -> list[tuple[float, float, float]]:
    """Points of the chassis: nine below, four above."""
    underside = [(i * x, j * y, belly) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return underside + [(i * x, j * y, roof) for i in (-1, 1) for j in (-1, 1)]
