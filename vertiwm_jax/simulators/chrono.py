"""Drives vehicles in Project Chrono, headless, on rigid, soft and mixed ground.

Written for PyChrono 9.0, and like the program that recorded `data/open` with 9.0.1: rigid tires,
SCM soil near the wheels alone, 5 ms steps. The HMMWV is Chrono's own, with locked differentials;
other vehicles are made of the numbers of their files (`chrono_vehicle`).
"""

import importlib
import math
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from vertiwm_jax import geometry
from vertiwm_jax.learning.dataset import WheelSignals
from vertiwm_jax.mechanics.vehicle import HMMWV, Vehicle, VehicleConfig, load
from vertiwm_jax.simulators import chrono_vehicle
from vertiwm_jax.simulators.chrono_ground import Ground
from vertiwm_jax.simulators.protocol import (
    SETTLE_SECONDS,
    Observation,
    SimulatorError,
    under_wheels,
)
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain.map import TerrainMap

STEP, SHORT_STEP = 5e-3, 2.5e-3
"""s, and of vehicles with wheels smaller than `SMALL`, m."""
SMALL = 0.37
SLOW = 0.45
"""m/s below which the gear changes its direction, of an HMMWV."""
DROP = 0.1
"""m above the ground at which wheels start."""
SOIL_WINDOW = (1.0, 0.6, 1.0)
"""m, box about each wheel of an HMMWV in which SCM looks for contact."""
SOIL_NEAR = 0.8
"""m from a wheel of an HMMWV within which soil counts, on mixed ground."""

_HMMWV = load(HMMWV)


def modules() -> tuple[Any, Any]:
    """`pychrono` and `pychrono.vehicle`; `SimulatorError` says where to get them."""
    try:
        return importlib.import_module("pychrono"), importlib.import_module("pychrono.vehicle")
    except ImportError as error:
        raise SimulatorError(
            "chrono: expected PyChrono 9.0 with its vehicle module, which comes from conda (conda "
            "install -c projectchrono -c conda-forge pychrono) or a source build, while the "
            f"package pychrono on PyPI is something else; found: {error}"
        ) from None


def expect(driven: VehicleConfig) -> None:
    """Raises `SimulatorError` where a vehicle cannot be driven in Chrono, or Chrono is missing."""
    chrono_vehicle.expect(driven)
    modules()


class Chrono:
    """A vehicle at full size on the selected world of a map, whose obstacles are solid boxes.

    Raises as `expect`.
    """

    def __init__(self, terrain: TerrainMap, driven: VehicleConfig = _HMMWV) -> None:
        expect(driven)
        self._modules, self._terrain, self._ground = modules(), terrain, Ground(terrain)
        self._driven, self._numbers = driven, driven.vehicle
        self._drive: _Drive | None = None

    def start(self, x: float, y: float, yaw: float) -> Observation:
        """As `Simulator.start`."""
        self._drive = None  # before the next: each holds a whole world
        place = np.array([x, y]) - self._ground.middle
        self._drive = _Drive(*self._modules, self._ground, self._driven, place, yaw)
        for _ in range(round(SETTLE_SECONDS / STEP_SECONDS)):
            self._drive.advance(0.0, 0.0, brake=True)
        return self._observe(self._drive)

    def step(self, command: np.ndarray) -> Observation:
        """As `Simulator.step`."""
        assert self._drive, "expected start before step"
        speed, steering = map(float, command)
        lock = float(self._numbers.steering_limit)
        self._drive.advance(speed, min(max(steering / lock, -1.0), 1.0))
        return self._observe(self._drive)

    def push(self, moved: np.ndarray, pushed: np.ndarray) -> None:
        """Moves the vehicle, `[3]` m, and adds to its velocity, `[3]` m/s, in the world frame."""
        assert self._drive, "expected start before push"
        self._drive.push(moved.tolist(), pushed.tolist())

    def _observe(self, drive: "_Drive") -> Observation:
        pose, twist, wheels, signals = drive.read()
        pose[:2] += self._ground.middle
        wheels[:, :2] += self._ground.middle
        found = _observed(self._terrain, self._numbers.wheel_radius, pose, twist, wheels)
        state, kind, depth = jax.device_get(found)
        return Observation(state, kind, replace(signals, wheel_sinkage=depth))


@jax.jit
def _observed(
    terrain: TerrainMap, radius: jax.Array, pose: jax.Array, twist: jax.Array, wheels: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """State `[12]`, classes and sinkages `[4]`, from position and quaternion `[7]`, velocity in
    the world and angular velocity in the body `[6]`, and wheel centers `[4, 3]`."""
    rotation = jaxlie.SO3(pose[3:])
    velocity = rotation.inverse() @ twist[:3]
    rpy = geometry.rpy_from_rotation(rotation)
    state = jnp.concatenate([pose[:3], rpy, velocity, twist[3:]])
    return state, *under_wheels(terrain, wheels, radius)


class _Drive:
    """One vehicle in one Chrono system; points are about the middle of the map."""

    def __init__(
        self,
        chrono: Any,
        vehicle: Any,
        ground: Ground,
        driven: VehicleConfig,
        place: np.ndarray,
        yaw: float,
    ) -> None:
        self._chrono, self._veh, self._ground = chrono, vehicle, ground
        self._driven, numbers = driven, driven.vehicle
        self._radius = float(numbers.wheel_radius.max())
        self._size = self._radius / float(_HMMWV.vehicle.wheel_radius)
        self._step = STEP if self._radius > SMALL else SHORT_STEP
        self._gear = 1
        self._steering_rate = round(float(numbers.steering_rate / numbers.steering_limit), 5)
        system = chrono.ChSystemNSC()
        system.SetGravitationalAcceleration(chrono.ChVector3d(0, 0, -9.81))
        system.SetCollisionSystemType(chrono.ChCollisionSystem.Type_BULLET)
        system.SetNumThreads(1, 1, 1)
        self._system = system
        self._rigid = ground.add_rigid(chrono, vehicle, system)
        self._scm, self._soil_map = ground.add_soil(vehicle, system)
        ground.add_boxes(chrono, system)
        self._add_vehicle(numbers, place, yaw)
        self._probes: list[Any] = []
        if self._scm:
            self._add_soil_windows()
        # Rigid tires touch the ground through the collision system; the terrain passed to
        # Synchronize only feeds slip read-outs nobody uses, so it is something cheap.
        self._flat = vehicle.FlatTerrain(-100.0)
        self._inputs = vehicle.DriverInputs()
        self._inputs.m_steering = self._inputs.m_throttle = 0.0
        self._inputs.m_braking = self._inputs.m_clutch = 0.0
        self._cruise = vehicle.ChSpeedController()
        self._cruise.Reset(self._car.GetRefFrame())
        self._cruise.SetGains(float(numbers.speed_gain), 0.0, 0.0)
        self._forces = np.zeros((5, 3))

    def _add_vehicle(self, numbers: Vehicle, place: np.ndarray, yaw: float) -> None:
        chrono, veh = self._chrono, self._veh
        cos, sin = math.cos(yaw), math.sin(yaw)
        wheels = np.asarray(numbers.wheel_position) @ np.array([[cos, sin], [-sin, cos]]) + place
        highest = float(self._ground.elevation(wheels).max())
        start = chrono.ChVector3d(*place.tolist(), highest + self._radius + DROP)
        where = chrono.ChCoordsysd(start, chrono.QuatFromAngleZ(float(yaw)))
        self._corners = [(0, veh.LEFT), (0, veh.RIGHT), (1, veh.LEFT), (1, veh.RIGHT)]
        self._car = self._hmmwv(where) if self._driven == _HMMWV else self._described(where)
        self._vehicle.EnableRealtime(False)
        self._chassis = self._vehicle.GetChassisBody()
        self._gears = veh.CastToChAutomaticTransmission(self._vehicle.GetTransmission())
        self._spindles = [self._vehicle.GetWheel(*corner).GetSpindle() for corner in self._corners]

    def _described(self, where: Any) -> Any:
        """A vehicle by the numbers of its file."""
        veh, before = self._veh, self._veh.GetDataPath()
        with TemporaryDirectory() as folder:
            chrono_vehicle.write(self._driven, Path(folder))
            veh.SetDataPath(f"{folder}/")
            car = veh.WheeledVehicle(self._system, f"{folder}/vehicle.json")
            car.Initialize(where)
            veh.SetDataPath(before)
        for corner in self._corners:
            car.GetWheel(*corner).GetTire().SetStepsize(self._step)
        locked = self._driven.locked
        for axle, name in enumerate(("front", "rear")):
            if locked in ("all", name):
                car.LockAxleDifferential(axle, True)
        if locked == "all":
            car.LockCentralDifferential(0, True)
        self._vehicle = car
        return car

    def _hmmwv(self, where: Any) -> Any:
        chrono, veh = self._chrono, self._veh
        car = veh.HMMWV_Reduced(self._system)
        car.SetContactMethod(chrono.ChContactMethod_NSC)
        car.SetChassisCollisionType(veh.CollisionType_PRIMITIVES)
        car.SetChassisFixed(False)
        car.SetEngineType(veh.EngineModelType_SIMPLE_MAP)
        car.SetTransmissionType(veh.TransmissionModelType_AUTOMATIC_SIMPLE_MAP)
        car.SetDriveType(veh.DrivelineTypeWV_AWD)
        car.SetTireType(veh.TireModelType_RIGID)
        car.SetTireStepSize(self._step)
        car.SetInitFwdVel(0.0)
        car.SetInitPosition(where)
        car.Initialize()
        car.LockAxleDifferential(0, True)
        car.LockAxleDifferential(1, True)
        car.LockCentralDifferential(0, True)
        self._vehicle = car.GetVehicle()
        return car

    def _add_soil_windows(self) -> None:
        """Limits SCM to a box around each wheel. On mixed ground the boxes hang on free-floating
        probes instead of the wheels, so that a wheel far from soil can be left out of SCM."""
        size = self._chrono.ChVector3d(*(self._size * np.array(SOIL_WINDOW)).tolist())
        if not self._ground.soft.all():
            self._probes = [self._chrono.ChBody() for _ in self._spindles]
        for body in self._probes or self._spindles:
            self._scm.AddMovingPatch(body, self._chrono.VNULL, size)

    def _move_probes(self) -> None:
        corners = self._size * SOIL_NEAR * np.array([(-1, -1), (1, -1), (-1, 1), (1, 1)])
        for probe, spindle in zip(self._probes, self._spindles, strict=False):
            pos = spindle.GetPos()
            if self._ground.is_soft(corners + (pos.x, pos.y)).any():
                probe.SetPos(pos)
                probe.SetRot(spindle.GetRot())
            else:
                probe.SetPos(self._chrono.ChVector3d(pos.x, pos.y, -1000.0))

    def advance(self, speed: float, steering: float, brake: bool = False) -> None:
        """Holds a speed, m/s, and a share of full lock for 0.1 s."""
        inputs, total, substeps = self._inputs, np.zeros((5, 3)), round(STEP_SECONDS / self._step)
        for _ in range(substeps):
            now = self._system.GetChTime()
            pedal = -1.0 if brake else self._pedal(speed, now)
            inputs.m_throttle, inputs.m_braking = max(pedal, 0.0), max(-pedal, 0.0)
            turn = self._steering_rate * self._step
            inputs.m_steering += max(-turn, min(turn, steering - inputs.m_steering))
            self._move_probes()
            self._car.Synchronize(now, inputs, self._flat)
            self._car.Advance(self._step)
            self._system.DoStepDynamics(self._step)
            total += self._contact_forces()
        self._forces = total / substeps

    def _pedal(self, speed: float, now: float) -> float:
        """Throttle, or braking below 0, for a speed, m/s; the gear changes where it is slow."""
        frame = self._car.GetRefFrame()
        pedal = self._cruise.Advance(frame, speed, now, self._step)
        forward = self._chrono.Vdot(frame.GetPosDt(), frame.GetRotMat().GetAxisX())
        wanted = 1 if speed >= 0 else -1
        if self._gear != wanted and abs(forward) < SLOW * math.sqrt(self._size):
            modes = self._veh.ChAutomaticTransmission
            mode = modes.DriveMode_FORWARD if wanted > 0 else modes.DriveMode_REVERSE
            self._gears.SetDriveMode(mode)
            self._gear = wanted
        pedal = wanted * pedal if self._gear == wanted else -abs(pedal)
        return max(-1.0, min(1.0, pedal))

    def push(self, moved: list[float], pushed: list[float]) -> None:
        """Moves all bodies alike, so that none of their joints notices."""
        vector = self._chrono.ChVector3d
        for body in self._system.GetBodies():
            if not body.IsFixed():
                body.SetPos(body.GetPos() + vector(*moved))
                body.SetPosDt(body.GetPosDt() + vector(*pushed))

    def _contact_forces(self) -> np.ndarray:
        """`[5, 3]` N on the wheels and the chassis over the last simulation step, world frame."""
        forces = np.empty((5, 3))
        for k, body in enumerate([*self._spindles, self._chassis]):
            forces[k] = _numbers(body.GetContactForce())
            if self._scm:
                force, moment = self._chrono.ChVector3d(), self._chrono.ChVector3d()
                if self._scm.GetContactForceBody(body, force, moment):
                    forces[k] += _numbers(force)
        return forces

    def read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, WheelSignals]:
        """The arguments of `_observed`, and the state of the wheels except their sinkage."""
        frame, spindles = self._car.GetRefFrame(), self._spindles
        q = frame.GetRot()
        pose = np.array([*_numbers(frame.GetPos()), q.e0, q.e1, q.e2, q.e3], np.float32)
        twist = np.array([*_numbers(frame.GetPosDt()), *_numbers(frame.GetAngVelLocal())])
        steering = [self._vehicle.GetSteeringAngle(*corner) for corner in self._corners[:2]]
        signals = WheelSignals(
            wheel_omega=np.array([s.GetAngVelLocal().y for s in spindles], np.float32),
            wheel_force=self._forces[:4].astype(np.float32),
            chassis_force=self._forces[4].astype(np.float32),
            steer_angle=np.array(steering, np.float32),
        )
        wheels = np.array([_numbers(s.GetPos()) for s in spindles], np.float32)
        return pose, twist.astype(np.float32), wheels, signals

    def __del__(self) -> None:
        # What refers to the Chrono system must go before the system itself.
        system = vars(self).pop("_system", None)
        vars(self).clear()
        del system


def _numbers(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z
