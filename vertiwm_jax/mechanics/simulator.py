"""The built-in simulator: a four-wheeled vehicle on rigid, soft and mixed ground.

A stand-in for a multibody simulator, differentiable throughout. Each 0.1 s command is held over a
few sub-steps of a linearly implicit integrator: springs, dampers, tire friction, wheel spin and
soil are stiff, and all of them act on the new velocity. Wheels carry spin inertia but no mass of
their own: a wheel is where the ground, or the droop of its damper, puts it.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from flax import struct

from vertiwm_jax import geometry
from vertiwm_jax.mechanics.contact import GroundContact, contacts, tangents
from vertiwm_jax.mechanics.drivetrain import actuate, drive_sides
from vertiwm_jax.mechanics.newton_euler import (
    ContactForce,
    DampedForce,
    Shaft,
    Twist,
    advance_twist,
    applied,
    turned,
    velocity_at,
)
from vertiwm_jax.mechanics.scm import ScmParams
from vertiwm_jax.mechanics.suspension import adhesion_speed, hull_contact, support, suspend
from vertiwm_jax.mechanics.tracks import Tracks
from vertiwm_jax.mechanics.vehicle import GRAVITY, Vehicle
from vertiwm_jax.mechanics.wheel import SoilContact
from vertiwm_jax.precision import float32
from vertiwm_jax.state import STEP_SECONDS, Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.ruts import Ruts
from vertiwm_jax.terrain.soil import Soil
from vertiwm_jax.vector import Axes, Vector

CREEP_SPEED = 0.01
"""Slip speed, m/s, below which the damping of friction is that of sticking."""


@struct.dataclass
class SimulatorParams:
    """vehicle; contact: of wheels in soil, whose type chooses between Wong's wheel and SCM.

    stiffening: `[]` factor on Bekker's moduli of the map's soils; 1 is the soil of the equations.
    """

    vehicle: Vehicle
    contact: SoilContact
    stiffening: jax.Array


@float32
def chrono_like(vehicle: Vehicle) -> SimulatorParams:
    """Chrono's soil contact model, fitted to the training drives of an HMMWV.

    Columns under a wheel that bounces carry more than under a steady one, and what 0.1 s see of
    its friction is spread over more slip.
    """
    return SimulatorParams(
        vehicle=jax.tree.map(jnp.asarray, vehicle),
        contact=ScmParams(*map(jnp.float32, (3e4, 1.0, 0.4)), nodes=4),
        stiffening=jnp.float32(1.8),
    )


@struct.dataclass
class SimulatorHistory:
    """What the 12-D state does not say.

    wheel_speed: `[4]` rad/s, positive forward.
    travel: `[4]` m, height of the wheel centers in the body.
    steering: `[]` rad, angle of the front wheels; rad/s of yaw that the sides of a skid-steered
        vehicle are driven to.
    gear: `[]` 1 forward, -1 reverse.
    sinkage: `[4]` m, of the wheels in soil; 0 on rigid ground.
    rut: `[2]` m, depth of the front wheels' tracks that the rear ones find, left and right.
    wheels: how each wheel met the ground in the last sub-step.
    force: `[4, 3]` N, of the ground on it: along the normal, along the rolling direction and to
        the left.
    speed: `[]` m/s that the sides of a skid-steered vehicle are driven to, None of others.
    ruts: what the wheels have pressed into the soil, None if the ground forgets it.
    """

    wheel_speed: jax.Array
    travel: jax.Array
    steering: jax.Array
    gear: jax.Array
    sinkage: jax.Array
    rut: jax.Array
    wheels: GroundContact
    force: jax.Array
    speed: jax.Array | None = None
    ruts: Ruts | None = None


class GroundForces(NamedTuple):
    """What the ground did in sub-steps `[...]`: force on the wheels `[..., 4, 3]` and on the hull
    `[..., 3]`, N, world frame."""

    wheels: jax.Array
    hull: jax.Array


class _Body(NamedTuple):
    """Pose and twist of the chassis while it is integrated."""

    position: Vector
    quaternion: jax.Array
    twist: Twist


@dataclass(frozen=True)
class Simulator:
    """The dynamics `init` / `step` of the built-in simulator."""

    substeps: int = 5
    """Steps of the integrator in 0.1 s."""
    ruts: bool = False
    """Whether soil remembers how deep wheels have pressed it, so that the next wheel, and the
    vehicle when it comes back, finds their ruts."""

    @float32
    def init(
        self, params: SimulatorParams, terrain: TerrainMap, state: VehicleState
    ) -> SimulatorHistory:
        """Wheels roll without slip, stand where the springs carry the weight, steer ahead; the gear
        is forward. A skid-steered vehicle turns as its wheels roll."""
        vehicle, none = params.vehicle, jnp.zeros(4)
        load, travel = vehicle.mass * GRAVITY / 4, vehicle.travel_at_rest
        position = Vector.of(state.position)
        axes = Axes.from_quaternion(geometry.rotation_from_rpy(state.rpy).wxyz)
        speed, steering, along = None, jnp.zeros(()), state.velocity[0]
        if vehicle.skid is not None:
            speed, steering = along / vehicle.skid.gain, state.angular_velocity[2]
            along = along - steering * vehicle.wheel_position[:, 1]
        return SimulatorHistory(
            wheel_speed=jnp.full(4, along / vehicle.wheel_radius),
            travel=travel,
            steering=steering,
            gear=jnp.ones(()),
            sinkage=none,
            rut=jnp.zeros(2),
            wheels=contacts(vehicle, terrain, position, axes, travel, none, none)[0],
            force=jnp.zeros((4, 3)).at[:, 0].set(load),
            speed=speed,
            ruts=Ruts.none(state.position) if self.ruts else None,
        )

    @float32
    def step(
        self,
        params: SimulatorParams,
        terrain: TerrainMap,
        history: SimulatorHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, SimulatorHistory]:
        return self.step_with_forces(params, terrain, history, state, command)[:2]

    def step_with_forces(
        self,
        params: SimulatorParams,
        terrain: TerrainMap,
        history: SimulatorHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, SimulatorHistory, GroundForces]:
        """`step`, and the forces in each of its sub-steps, leaves `[substeps, ...]`."""
        center = Vector.of(params.vehicle.centre_of_mass)
        angular = Vector.of(state.angular_velocity)
        linear = Vector.of(state.velocity).plus(angular.cross(center))
        quaternion = geometry.rotation_from_rpy(state.rpy).wxyz
        body = _Body(Vector.of(state.position), quaternion, Twist(linear, angular))

        def substep(
            carry: tuple[_Body, SimulatorHistory], _: None
        ) -> tuple[tuple[_Body, SimulatorHistory], GroundForces]:
            seconds = STEP_SECONDS / self.substeps
            body, history, forces = _substep(params, terrain, *carry, command, seconds)
            return (body, history), forces

        if history.ruts is not None:
            history = replace(history, ruts=history.ruts.followed(state.position))
        (body, history), forces = jax.lax.scan(substep, (body, history), None, length=self.substeps)
        linear, angular = body.twist
        return (
            VehicleState(
                position=body.position.stacked(),
                rpy=geometry.rpy_from_rotation(jaxlie.SO3(body.quaternion)),
                velocity=linear.plus(angular.cross(center), -1.0).stacked(),
                angular_velocity=angular.stacked(),
            ),
            history,
            forces,
        )


def _substep(
    params: SimulatorParams,
    terrain: TerrainMap,
    body: _Body,
    history: SimulatorHistory,
    command: Command,
    seconds: float,
) -> tuple[_Body, SimulatorHistory, GroundForces]:
    vehicle = params.vehicle
    axes = Axes.from_quaternion(body.quaternion)
    center = Vector.of(vehicle.centre_of_mass)
    forward = body.twist.linear.x
    spin, before = history.wheel_speed, history.sinkage
    if vehicle.skid is None or history.speed is None:
        driven = actuate(vehicle, command, forward, history.steering, history.gear, spin, seconds)
    else:
        told = command, history.steering, history.speed
        driven = drive_sides(vehicle, vehicle.skid, *told, spin, seconds)
    where = body.position, axes, history.travel, driven.angle
    wheels, hull = contacts(vehicle, terrain, *where, before)
    n, arm = wheels.normal, wheels.point.plus(center, -1.0)
    rolling, lateral = tangents(n, jnp.cos(driven.angle), jnp.sin(driven.angle))
    velocity = velocity_at(body.twist, arm)
    ahead, drift = velocity.dot(rolling), velocity.dot(lateral)

    sunk = jnp.where(wheels.soft, before, 0.0)
    press = suspend(vehicle, wheels, history.travel, sunk, velocity.dot(n), seconds)
    soil, ruts, tracks = stiffened(params, wheels.soil), history.ruts, None
    if ruts is None:
        rut = jnp.concatenate([jnp.zeros(2), history.rut])
    else:
        tracks = Tracks.of(vehicle, body.position, axes, wheels, rolling, ahead)
        rut = tracks.found(ruts, vehicle, before)
    ground, sinkage, load, rate = support(
        vehicle, params.contact, soil, wheels, press, before, (ahead, drift, spin), rut
    )

    # What friction loses per slip: the secant to no friction at no slip.
    radius = vehicle.wheel_radius
    sliding = jnp.sqrt((ahead - radius * spin) ** 2 + drift**2 + CREEP_SPEED**2)
    still = (CREEP_SPEED / adhesion_speed(vehicle) * load) ** 2 + 1.0
    grip = jnp.sqrt((ground.torque / radius) ** 2 + ground.lateral**2 + still) / sliding

    # Wheel spin is eliminated: traction is what is left of it once the spin has answered.
    inertia = vehicle.wheel_inertia + seconds * (driven.brake + radius**2 * grip)
    spin_up = seconds * (driven.torque - driven.brake * spin - ground.torque) / inertia
    shaft, free = None, 1.0
    if vehicle.locked is not None:
        # Wheels on one shaft answer by its spin alone.
        free = 1 - vehicle.locked
        on_shaft = vehicle.locked * inertia
        total = jnp.sum(on_shaft)
        total = jnp.where(total > 0, total, 1.0)
        common = jnp.sum(on_shaft * (spin + spin_up)) / total
        spin_up = free * spin_up + vehicle.locked * (common - spin)
        shaft = Shaft(arm, rolling.times(vehicle.locked * radius * grip), total)
    traction = ground.longitudinal + radius * grip * spin_up
    traction_rate = grip * (1 - free * seconds * radius**2 * grip / inertia)

    on_wheels = ContactForce.of(
        arm,
        DampedForce(n, load, seconds * rate),
        DampedForce(rolling, traction, traction_rate),
        DampedForce(lateral, ground.lateral, grip),
    )
    on_hull = hull_contact(vehicle, body.twist, hull, center, seconds)
    gravity = Vector(axes.x.z, axes.y.z, axes.z.z).times(-GRAVITY)
    inertia_of_body = Vector.of(vehicle.inertia)
    twist = advance_twist(
        body.twist, vehicle.mass, inertia_of_body, gravity, [on_wheels, on_hull], seconds, shaft
    )

    spin = spin + spin_up
    of_wheels, of_hull = (applied(contact, body.twist, twist) for contact in (on_wheels, on_hull))
    if shaft is not None and vehicle.locked is not None:
        gained = shaft.gained(body.twist, twist, seconds)
        spin = spin + vehicle.locked * gained
        of_wheels = of_wheels.plus(shaft.pull, gained)
    gained = velocity_at(twist, arm).plus(velocity, -1.0)
    pushed = press.depth - sinkage - seconds * gained.dot(n)
    # The rear wheels find the front ones' ruts a wheelbase later, as far as they track them.
    fresh = 1 - jnp.exp(-seconds * jnp.abs(forward) / vehicle.wheelbase)
    history = SimulatorHistory(
        wheel_speed=spin + free * seconds * radius * grip * gained.dot(rolling) / inertia,
        travel=jnp.clip(
            press.droop + jnp.where(press.carrying, pushed / press.upright, 0.0),
            vehicle.free_travel - radius,
            vehicle.free_travel + radius,
        ),
        steering=driven.steering,
        gear=driven.gear,
        sinkage=jnp.where(wheels.edge, before, sinkage),
        rut=history.rut + fresh * (sinkage[:2] - history.rut),
        wheels=wheels,
        force=jnp.stack([load, traction, ground.lateral], axis=-1),
        speed=driven.speed,
        ruts=tracks.left(ruts, sinkage, seconds) if ruts and tracks else None,
    )
    of_wheels, of_hull = (axes.to_world(force).stacked() for force in (of_wheels, of_hull))
    on_ground = GroundForces(of_wheels, of_hull[0])
    return _advance_pose(vehicle, body, axes, center, twist, seconds), history, on_ground


def stiffened(params: SimulatorParams, soil: Soil) -> Soil:
    """The soil `[...]` that the wheels meet, of one of the map's."""
    return replace(soil, kc=params.stiffening * soil.kc, kphi=params.stiffening * soil.kphi)


def _advance_pose(
    vehicle: Vehicle, body: _Body, axes: Axes, center: Vector, twist: Twist, seconds: float
) -> _Body:
    """Moves the center of mass by the new velocity and turns the body about it."""
    turn = geometry.rotation_from_vector(seconds * twist.angular.stacked())
    quaternion = geometry.compose(jaxlie.SO3(body.quaternion), turn).wxyz
    at_center = axes.to_world(center.plus(twist.linear, seconds))
    # Of the large number that a place may be, only one sum is rounded.
    gone = at_center.plus(Axes.from_quaternion(quaternion).to_world(center), -1.0)
    position = body.position.plus(gone)
    inertia = Vector.of(vehicle.inertia)
    return _Body(position, quaternion, turned(twist, inertia, Axes.from_quaternion(turn.wxyz)))
