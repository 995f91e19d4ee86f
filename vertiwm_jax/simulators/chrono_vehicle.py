"""A vehicle for Project Chrono, made of the numbers of its file.

Suspension and steering are those of Chrono's `HMMWV_Reduced`, enlarged to the wheels and the track:
double wishbones without mass, rack and pinion. Masses, springs, engine and brakes are the file's.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from vertiwm_jax.mechanics.vehicle import HMMWV, Vehicle, VehicleConfig, load
from vertiwm_jax.simulators.protocol import SimulatorError

Files = dict[str, dict[str, Any]]
_HMMWV = load(HMMWV)

# Points of the reduced HMMWV, m from the middle of an axle; the y axis is to the left.
_POINTS = {
    "front": {
        "upper": ((-0.048, 0.446, 0.245), (-0.268, 0.478, 0.196), (-0.053, 0.716, 0.215)),
        "lower": ((0.223, 0.307, 0.0), (-0.223, 0.307, 0.0), (-0.036, 0.787, -0.118)),
        "tie rod": ((-0.250, 0.448, 0.054), (-0.176, 0.821, -0.016)),
        "shock": ((0.104, 0.498, 0.323), (0.097, 0.543, -0.047)),
        "spindle": (-0.040, 0.910, -0.026),
        "upright": (-0.040, 0.751, -0.026),
    },
    "rear": {
        "upper": ((0.349, 0.462, 0.228), (0.077, 0.462, 0.224), (0.036, 0.716, 0.216)),
        "lower": ((0.223, 0.307, 0.0), (-0.223, 0.307, 0.0), (0.036, 0.787, -0.118)),
        "tie rod": ((0.223, 0.416, 0.059), (0.170, 0.821, -0.009)),
        "shock": ((-0.104, 0.498, 0.323), (-0.097, 0.544, -0.038)),
        "spindle": (0.036, 0.910, -0.026),
        "upright": (0.036, 0.751, -0.026),
    },
}
_FREE_LENGTH = {"front": 0.339, "rear": 0.382}
_STRUT_SPRING = {"front": 167062.0, "rear": 369149.0}
_STRUT_DAMPER = {"front": 22459.0, "rear": 35024.0}
_HEIGHT = 0.0264  # m, of the middle of an axle above the chassis frame
_RACK = (0.25, 0.0806)  # m that steering lies behind the front axle and above the chassis frame
_FOLLOWED = 0.7  # rad that front wheels turn for one of the pinion
_MASSES = {"spindle": 15.91, "upright": 27.27, "wheel": 18.8, "tire": 37.6}
_LINK = 9.072  # kg, of the steering
_SPIN = {"axle": 0.4, "spindle": 4.0, "wheel": 0.6243, "tire": 6.69}  # kg m2
_TORQUE = (
    (-100, 300), (800, 382), (900, 490), (1000, 579), (1100, 650), (1200, 706), (1300, 746),
    (1400, 774), (1500, 789), (1600, 793), (1700, 788), (1800, 774), (1900, 754), (2000, 728),
    (2100, 697), (2200, 664), (2300, 628), (2400, 593), (2500, 558), (2700, -400),
)  # fmt: skip
_DRAG = ((-100, 0), (0, 0), (100, 0), (1000, -50), (2000, -70), (3000, -90))
_GEARS = (0.1708, 0.2791, 0.4218, 0.6223, 1.0173, 1.5361)
_REVERSE_GEAR, _FINAL_GEAR = -0.151, 0.2
_REST_TORQUE = 382 / -_REVERSE_GEAR / _FINAL_GEAR / 4  # N m at each of four wheels, in reverse
_CONTACT = {
    "Coefficient of Restitution": 0.1,
    "Properties": {"Young Modulus": 2e7, "Poisson Ratio": 0.3},
    "Coefficients": {
        "Normal Stiffness": 2e5,
        "Normal Damping": 40.0,
        "Tangential Stiffness": 2e5,
        "Tangential Damping": 20.0,
    },
}
_CHASSIS_FRICTION = 0.4


def expect(config: VehicleConfig) -> None:
    """Raises `SimulatorError` unless a vehicle can be made of such parts."""
    if config.skid:
        raise SimulatorError("vehicle: expected one whose front wheels steer, in Chrono")
    left = _chassis_mass(config.vehicle)
    if left <= 0:
        raise SimulatorError(
            f"vehicle: expected, in Chrono, wheels with hubs of less than its {config.mass:g} kg, "
            f"found wheel_weight {config.wheel_weight:g} N of each"
        )


def write(config: VehicleConfig, folder: Path) -> None:
    """Writes the JSON files that Chrono reads, of which `vehicle.json` names the others."""
    for name, content in files(config).items():
        (folder / f"{name}.json").write_text(json.dumps({"Name": name, **content}))


def files(config: VehicleConfig) -> Files:
    """What Chrono reads of a vehicle at full size with front wheels that steer, by file."""
    car, own = config.vehicle, _HMMWV.vehicle
    size = float(car.wheel_radius.mean() / own.wheel_radius.mean())
    heavy = _heavy(car)
    spin = float(car.wheel_inertia / own.wheel_inertia)
    made: Files = {"chassis": _chassis(car, heavy), "steering": _steering(car, size, heavy)}
    for axle, name in enumerate(("front", "rear")):
        wheel = 2 * axle
        made[name] = _suspension(car, name, wheel, size, heavy, spin)
        made[f"{name}_tire"] = {
            "Type": "Tire",
            "Template": "RigidTire",
            "Radius": float(np.broadcast_to(car.wheel_radius, 4)[wheel]),
            "Width": float(np.broadcast_to(car.wheel_width, 4)[wheel]),
            "Mass": _MASSES["tire"] * heavy,
            "Inertia": [3.84 * spin, _SPIN["tire"] * spin, 3.84 * spin],
            "Contact Material": {"Coefficient of Friction": float(car.tyre_friction), **_CONTACT},
        }
    made["wheel"] = {
        "Type": "Wheel",
        "Template": "Wheel",
        "Mass": _MASSES["wheel"] * heavy,
        "Inertia": [0.4634 * spin, _SPIN["wheel"] * spin, 0.4634 * spin],
    }
    brake = {"Type": "Brake", "Template": "BrakeSimple", "Maximum Torque": float(car.brake_torque)}
    made |= {"brake": brake, **_powertrain(config), "vehicle": _vehicle(config, size)}
    return made


def _heavy(car: Vehicle) -> float:
    """How heavy wheels, hubs and steering are, as a share of the HMMWV's."""
    return float(car.wheel_weight / _HMMWV.vehicle.wheel_weight)


def _chassis_mass(car: Vehicle) -> float:
    """kg, without wheels, hubs and steering."""
    return float(car.mass) - _heavy(car) * (4 * sum(_MASSES.values()) + _LINK)


def _point(point: tuple[float, ...], size: float, wide: float) -> list[float]:
    """m: enlarged, sideways by another factor."""
    x, y, z = point
    return [float(size * x), float(wide * y), float(size * z)]


def _chassis(car: Vehicle, heavy: float) -> dict[str, Any]:
    """What is left of mass and inertia without the wheels and the steering."""
    corner, mass = heavy * sum(_MASSES.values()), _chassis_mass(car)
    middle = np.asarray(car.centre_of_mass, float) * float(car.mass) / mass
    away = np.column_stack([car.wheel_position, np.zeros(4)]) - car.centre_of_mass
    parts = [(corner, corner_away) for corner_away in away]
    parts += [(mass, middle - car.centre_of_mass)]
    moved = sum(m * (np.dot(r, r) * np.ones(3) - r**2) for m, r in parts)
    inertia = np.maximum(np.asarray(car.inertia, float) - moved, 0.2 * car.inertia)
    low, high = np.min(car.hull, axis=0), np.max(car.hull, axis=0)
    return {
        "Type": "Chassis",
        "Template": "RigidChassis",
        "Components": [
            {
                "Centroidal Frame": {"Location": middle.tolist(), "Orientation": [1, 0, 0, 0]},
                "Mass": mass,
                "Moments of Inertia": inertia.tolist(),
                "Products of Inertia": [0, 0, 0],
                "Void": False,
            }
        ],
        "Driver Position": {"Location": [0, 0, 1], "Orientation": [1, 0, 0, 0]},
        "Contact": {
            "Materials": [{"Coefficient of Friction": _CHASSIS_FRICTION, **_CONTACT}],
            "Shapes": [
                {
                    "Type": "BOX",
                    "Location": ((low + high) / 2).tolist(),
                    "Orientation": [1, 0, 0, 0],
                    "Dimensions": (high - low).tolist(),
                    "Material Index": 0,
                }
            ],
        },
    }


def _suspension(
    car: Vehicle, name: str, wheel: int, size: float, heavy: float, spin: float
) -> dict[str, Any]:
    points, own = _POINTS[name], _HMMWV.vehicle
    wide = float(car.wheel_position[wheel, 1]) / points["spindle"][1]
    spring, damper = (
        float(getattr(car, each)[wheel] / getattr(own, each)[wheel])
        for each in ("spring", "damper")
    )
    # The strut moves less than the wheel, as its spring is stiffer.
    share = float(np.sqrt(own.spring[wheel] / _STRUT_SPRING[name]))
    longer = share * float(size * own.free_travel[wheel] - car.free_travel[wheel])

    def at(*of: tuple[float, ...]) -> list[list[float]]:
        return [_point(point, size, wide) for point in of]

    link = "Location Chassis", "Location Upright"
    arm = "Location Chassis Front", "Location Chassis Back", "Location Upright"
    (spindle,), (upright,), shock = at(points["spindle"]), at(points["upright"]), points["shock"]
    return {
        "Type": "Suspension",
        "Template": "DoubleWishboneReduced",
        "Camber Angle (deg)": 0,
        "Toe Angle (deg)": 0,
        "Spindle": {
            "Mass": _MASSES["spindle"] * heavy,
            "COM": spindle,
            "Inertia": [2 * spin, _SPIN["spindle"] * spin, 2 * spin],
            "Radius": 0.15 * size,
            "Width": 0.06 * size,
        },
        "Upright": {
            "Mass": _MASSES["upright"] * heavy,
            "COM": upright,
            "Inertia": [5 * spin] * 3,
            "Radius": 0.025 * size,
        },
        "Upper Control Arm": dict(zip(arm, at(*points["upper"]), strict=True)),
        "Lower Control Arm": dict(zip(arm, at(*points["lower"]), strict=True)),
        "Tierod": dict(zip(link, at(*points["tie rod"]), strict=True)),
        "Shock": {
            **dict(zip(link, at(*shock), strict=True)),
            "Free Length": size * _FREE_LENGTH[name] + longer,
            "Spring Coefficient": _STRUT_SPRING[name] * spring,
            "Damping Coefficient": _STRUT_DAMPER[name] * damper,
        },
        "Axle": {"Inertia": _SPIN["axle"] * spin},
    }


def _steering(car: Vehicle, size: float, heavy: float) -> dict[str, Any]:
    turned = float(car.steering_limit) / _FOLLOWED
    wide = float(car.wheel_position[0, 1]) / _POINTS["front"]["spindle"][1]
    return {
        "Type": "Steering",
        "Template": "RackPinion",
        "Steering Link": {
            "Mass": _LINK * heavy,
            "COM": 0,
            "Inertia": [float(size**2 * heavy)] * 3,
            "Radius": 0.03 * size,
            "Length": 0.896 * wide,
        },
        "Pinion": {"Radius": 0.1 * size, "Maximum Angle (deg)": float(np.degrees(turned))},
    }


def _powertrain(config: VehicleConfig) -> Files:
    """Engine and gears of the HMMWV, of another torque and other speeds, and the shafts."""
    car, own = config.vehicle, _HMMWV.vehicle
    wheels = 4 if config.drive == "all" else 2
    strong = float(wheels * car.wheel_torque / (4 * own.wheel_torque))
    fast = float(wheels * car.wheel_power / (4 * own.wheel_power)) / strong
    back = 1.0
    if car.reverse_torque is not None:
        back = strong * _REST_TORQUE * 4 / float(wheels * car.reverse_torque)
    inertia = 0.5 * float(car.wheel_inertia / own.wheel_inertia)
    shafts = {"Driveshaft": inertia}
    most = 100 * strong  # N m that differentials which lock by themselves would take
    common = {"Shaft Direction": {"Motor Block": [1, 0, 0], "Axle": [0, 1, 0]}}
    if config.drive == "all":
        shafts |= {f"{end} Driveshaft": inertia for end in ("Front", "Rear")}
        shafts |= {f"{at} Differential Box": 1.2 * inertia for at in ("Central", "Front", "Rear")}
        gears = {f"{end} Conical Gear": _FINAL_GEAR for end in ("Front", "Rear")}
        common |= {"Template": "ShaftsDriveline4WD", "Central Differential Locking Limit": most}
    else:
        shafts |= {"Differential Box": 1.2 * inertia}
        gears = {"Conical Gear": _FINAL_GEAR}
        common |= {"Template": "ShaftsDriveline2WD"}
    return {
        "engine": {
            "Type": "Engine",
            "Template": "EngineSimpleMap",
            "Maximal Engine Speed RPM": 2600 * fast,
            "Map Full Throttle": [[a * fast, b * strong] for a, b in _TORQUE],
            "Map Zero Throttle": [[a * fast, b * strong] for a, b in _DRAG],
        },
        "transmission": {
            "Type": "Transmission",
            "Template": "AutomaticTransmissionSimpleMap",
            "Gear Box": {
                "Reverse Gear Ratio": _REVERSE_GEAR * back,
                "Forward Gear Ratios": list(_GEARS),
                "Shift Points Map RPM": [
                    [1000 * fast, shift * fast] for shift in (*[2220] * 5, 2700)
                ],
            },
        },
        "driveline": {
            "Type": "Driveline",
            "Shaft Inertia": shafts,
            "Gear Ratio": gears,
            "Axle Differential Locking Limit": most,
            **common,
        },
    }


def _vehicle(config: VehicleConfig, size: float) -> dict[str, Any]:
    car = config.vehicle
    places = {"front": float(car.wheel_position[0, 0]), "rear": float(car.wheel_position[2, 0])}
    # The spindles lie a little before and behind the middles of their axles.
    places = {name: x - size * _POINTS[name]["spindle"][0] for name, x in places.items()}
    axles = [
        {
            "Suspension Input File": f"{name}.json",
            "Suspension Location": [float(x), 0, float(size * _HEIGHT)],
            "Left Wheel Input File": "wheel.json",
            "Right Wheel Input File": "wheel.json",
            "Left Brake Input File": "brake.json",
            "Right Brake Input File": "brake.json",
            "Tire Input File": f"{name}_tire.json",
        }
        for name, x in places.items()
    ]
    behind, above = _RACK
    rack = [float(places["front"] - size * behind), 0, float(size * above)]
    driven = {"all": [0, 1], "front": [0], "rear": [1]}[config.drive]
    return {
        "Type": "Vehicle",
        "Template": "WheeledVehicle",
        "Chassis": {"Input File": "chassis.json"},
        "Axles": [{**axles[0], "Steering Index": 0}, axles[1]],
        "Steering Subsystems": [
            {"Input File": "steering.json", "Location": rack, "Orientation": [1, 0, 0, 0]}
        ],
        "Wheelbase": float(car.wheel_position[0, 0] - car.wheel_position[2, 0]),
        "Minimum Turning Radius": 7.62 * float(size),
        "Maximum Steering Angle (deg)": float(np.degrees(car.steering_limit)),
        "Powertrain": {
            "Engine Input File": "engine.json",
            "Transmission Input File": "transmission.json",
        },
        "Driveline": {"Input File": "driveline.json", "Suspension Indexes": driven},
    }
