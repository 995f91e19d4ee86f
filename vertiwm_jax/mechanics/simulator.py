"""The built-in simulator: a four-wheeled vehicle on rigid, soft and mixed ground.

A stand-in for a multibody simulator, differentiable throughout. Each 0.1 s command is held over a
few sub-steps of a linearly implicit integrator: springs, dampers, tyre friction, wheel spin and
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
from vertiwm_jax.mechanics.newton_euler import (
    ContactForce,
    Push,
    Twist,
    advance_twist,
    applied,
    turned,
    velocity_at,
)
from vertiwm_jax.mechanics.scm import ScmContact, soil_forces
from vertiwm_jax.mechanics.touch import Touch, touch
from vertiwm_jax.mechanics.vehicle import GRAVITY, Vehicle
from vertiwm_jax.mechanics.wheel import Contact, Wheel, WheelForces, rigid_forces
from vertiwm_jax.state import STEP_SECONDS, Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import Soil
from vertiwm_jax.vector import Axes, Vector

ADHESION_SPEED = 0.1
"""Slip speed, m/s, at which friction has reached 70 % of its limit."""
SPIN_FLOOR = 0.5
"""Wheel speed, rad/s, below which a locked brake lets a wheel creep."""
QUADRATURE_NODES = 4
"""In each piece of a wheel's contact."""
LEAST_SINKAGE = 1e-3
"""Sinkage, m, below which soil counts as linear."""
LARGEST_LOAD = 2.5
"""Largest normal force on one wheel, in vehicle weights."""
LEAST_UPRIGHT = 0.2
"""Cosine between body and ground normal below which wheels no longer carry."""
HULL_SECONDS = 0.1
"""Time in which the hull, lying on ground, would drop by its depth under the weight."""
HULL_FRICTION = 0.5
HULL_LOAD = 10.0
"""Largest force on the hull, in vehicle weights."""
HULL_DEPTH = 0.1
"""Depth, m, beyond which the hull is pushed out no faster: what is deep in comes out slowly."""
CLIMB_SPEED = 2.0
"""Speed, m/s, at which a wheel that finds itself in the ground is lifted out of it."""
CREEP_SPEED = 0.01
"""Slip speed, m/s, below which the damping of friction is that of sticking."""


@struct.dataclass
class SimulatorParams:
    """vehicle; contact: of wheels in soil, whose type chooses between Wong's wheel and SCM.

    stiffening: `[]` factor on Bekker's moduli of the map's soils; 1 is the soil of the equations.
    """

    vehicle: Vehicle
    contact: Contact | ScmContact
    stiffening: jax.Array


def chrono_like(vehicle: Vehicle) -> SimulatorParams:
    """Chrono's soil contact model, fitted to the training drives of an HMMWV.

    Columns under a wheel that bounces carry more than under a steady one, and what 0.1 s see of
    its friction is spread over more slip.
    """
    return SimulatorParams(
        vehicle=jax.tree.map(jnp.asarray, vehicle),
        contact=ScmContact(*map(jnp.float32, (3e4, 1.0, 0.4))),
        stiffening=jnp.float32(1.8),
    )


@struct.dataclass
class SimulatorHistory:
    """What the 12-D state does not say.

    wheel_speed: `[4]` rad/s, positive forward.
    travel: `[4]` m, height of the wheel centres in the body.
    steering: `[]` rad, angle of the front wheels.
    sinkage: `[4]` m, of the wheels in soil; 0 on rigid ground.
    rut: `[2]` m, depth of the tracks that the rear wheels find, left and right.
    wheels: how each wheel met the ground in the last sub-step.
    force: `[4, 3]` N, of the ground on it: along the normal, along the rolling direction and to
        the left.
    """

    wheel_speed: jax.Array
    travel: jax.Array
    steering: jax.Array
    sinkage: jax.Array
    rut: jax.Array
    wheels: Touch
    force: jax.Array


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

    def init(
        self, params: SimulatorParams, terrain: TerrainMap, state: VehicleState
    ) -> SimulatorHistory:
        """Wheels roll without slip, stand where the springs carry the weight, steer ahead."""
        vehicle, none = params.vehicle, jnp.zeros(4)
        load, travel = vehicle.mass * GRAVITY / 4, vehicle.travel_at_rest
        position = Vector.of(state.position)
        axes = Axes.from_quaternion(geometry.rotation_from_rpy(state.rpy).wxyz)
        return SimulatorHistory(
            wheel_speed=jnp.full(4, state.velocity[0] / vehicle.wheel_radius),
            travel=travel,
            steering=jnp.zeros(()),
            sinkage=none,
            rut=jnp.zeros(2),
            wheels=touch(vehicle, terrain, position, axes, travel, none, none)[0],
            force=jnp.zeros((4, 3)).at[:, 0].set(load),
        )

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
        centre = Vector.of(params.vehicle.centre_of_mass)
        angular = Vector.of(state.angular_velocity)
        linear = Vector.of(state.velocity).plus(angular.cross(centre))
        quaternion = geometry.rotation_from_rpy(state.rpy).wxyz
        body = _Body(Vector.of(state.position), quaternion, Twist(linear, angular))

        def substep(
            carry: tuple[_Body, SimulatorHistory], _: None
        ) -> tuple[tuple[_Body, SimulatorHistory], GroundForces]:
            seconds = STEP_SECONDS / self.substeps
            body, history, forces = _substep(params, terrain, *carry, command, seconds)
            return (body, history), forces

        (body, history), forces = jax.lax.scan(substep, (body, history), None, length=self.substeps)
        linear, angular = body.twist
        return (
            VehicleState(
                position=body.position.stacked(),
                rpy=geometry.rpy_from_rotation(jaxlie.SO3(body.quaternion)),
                velocity=linear.plus(angular.cross(centre), -1.0).stacked(),
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
    centre = Vector.of(vehicle.centre_of_mass)
    forward = body.twist.linear.x
    pedal = jnp.clip(vehicle.speed_gain * (command.speed - forward), -1.0, 1.0)
    target = jnp.clip(command.steering, -vehicle.steering_limit, vehicle.steering_limit)
    turn = vehicle.steering_rate * seconds
    steering = history.steering + jnp.clip(target - history.steering, -turn, turn)

    steer = jnp.concatenate([jnp.full(2, steering), jnp.zeros(2)])
    before = history.sinkage
    wheels, hull = touch(vehicle, terrain, body.position, axes, history.travel, steer, before)
    n, arm = wheels.normal, wheels.point.plus(centre, -1.0)
    rolling, lateral = _tangents(n, jnp.cos(steer), jnp.sin(steer))
    velocity = velocity_at(body.twist, arm)
    ahead, drift = velocity.dot(rolling), velocity.dot(lateral)

    sunk = jnp.where(wheels.soft, before, 0.0)
    press = _suspend(vehicle, wheels, history.travel, sunk, velocity.dot(n), seconds)
    rut = jnp.concatenate([jnp.zeros(2), history.rut])
    ground, sinkage, load, rate = _support(params, wheels, press, history, ahead, drift, rut)

    # What friction loses per slip: the secant to no friction at no slip.
    radius = vehicle.wheel_radius
    sliding = jnp.sqrt((ahead - radius * history.wheel_speed) ** 2 + drift**2 + CREEP_SPEED**2)
    still = (CREEP_SPEED / ADHESION_SPEED * load) ** 2 + 1.0
    grip = jnp.sqrt((ground.torque / radius) ** 2 + ground.lateral**2 + still) / sliding

    # Wheel spin is eliminated: traction is what is left of it once the spin has answered.
    drive, brake = _drivetrain(vehicle, pedal, history.wheel_speed)
    inertia = vehicle.wheel_inertia + seconds * (brake + radius**2 * grip)
    spin_up = seconds * (drive - brake * history.wheel_speed - ground.torque) / inertia
    traction = ground.longitudinal + radius * grip * spin_up
    traction_rate = grip * (1 - seconds * radius**2 * grip / inertia)

    on_wheels = ContactForce.of(
        arm,
        Push(n, load, seconds * rate),
        Push(rolling, traction, traction_rate),
        Push(lateral, ground.lateral, grip),
    )
    on_hull = _hull_contact(vehicle, body.twist, hull, centre, seconds)
    gravity = Vector(axes.x.z, axes.y.z, axes.z.z).times(-GRAVITY)
    twist = advance_twist(
        body.twist,
        vehicle.mass,
        Vector.of(vehicle.inertia),
        gravity,
        [on_wheels, on_hull],
        seconds,
    )

    gained = velocity_at(twist, arm).plus(velocity, -1.0)
    pushed = press.depth - sinkage - seconds * gained.dot(n)
    # The rear wheels find the front ones' ruts a wheelbase later, as far as they track them.
    fresh = 1 - jnp.exp(-seconds * jnp.abs(forward) / vehicle.wheelbase)
    history = SimulatorHistory(
        wheel_speed=history.wheel_speed
        + spin_up
        + seconds * radius * grip * gained.dot(rolling) / inertia,
        travel=jnp.clip(
            press.droop + jnp.where(press.carrying, pushed / press.upright, 0.0),
            vehicle.free_travel - radius,
            vehicle.free_travel + radius,
        ),
        steering=steering,
        sinkage=jnp.where(wheels.edge, before, sinkage),
        rut=history.rut + fresh * (sinkage[:2] - history.rut),
        wheels=wheels,
        force=jnp.stack([load, traction, ground.lateral], axis=-1),
    )
    forces = (applied(contact, body.twist, twist) for contact in (on_wheels, on_hull))
    of_wheels, of_hull = (axes.to_world(force).stacked() for force in forces)
    on_ground = GroundForces(of_wheels, of_hull[0])
    return _advance_pose(vehicle, body, axes, centre, twist, seconds), history, on_ground


class _Press(NamedTuple):
    """How the suspension presses each wheel `[4]` onto the ground.

    droop: m, the height in the body to which a free wheel would fall within the sub-step.
    depth: m below the tangent plane at that height. upright: cosine between body and normal.
    stiffness: N/m along the normal. carrying: bool.
    """

    droop: jax.Array
    depth: jax.Array
    upright: jax.Array
    stiffness: jax.Array
    carrying: jax.Array


def _suspend(
    vehicle: Vehicle,
    wheels: Touch,
    travel: jax.Array,
    sinkage: jax.Array,
    leaving: jax.Array,
    seconds: float,
) -> _Press:
    """Implicit Euler of a massless wheel between spring, damper, its weight and the ground.

    leaving: `[4]` m/s, velocity along the normal.
    """
    upright = jnp.maximum(wheels.normal.z, LEAST_UPRIGHT)
    damping = vehicle.damper / seconds
    stiffness = vehicle.spring + damping
    relaxed = vehicle.spring * vehicle.free_travel + damping * travel - vehicle.wheel_weight
    droop = relaxed / stiffness
    stepped_in = jnp.minimum(wheels.depth, sinkage + CLIMB_SPEED * seconds)
    depth = stepped_in + upright * (travel - droop) - seconds * leaving
    carrying = (wheels.normal.z > LEAST_UPRIGHT) & (depth > 0)
    # Beyond the largest load a contact yields: no wheel is thrown out of ground it stepped into.
    largest = LARGEST_LOAD * vehicle.mass * GRAVITY
    pressed = jnp.maximum(depth - sinkage, LEAST_SINKAGE)
    stiffness = jnp.minimum(stiffness / upright**2, largest / pressed)
    return _Press(droop, depth, upright, jnp.where(carrying, stiffness, 0.0), carrying)


def _support(
    params: SimulatorParams,
    wheels: Touch,
    press: _Press,
    history: SimulatorHistory,
    ahead: jax.Array,
    drift: jax.Array,
    rut: jax.Array,
) -> tuple[WheelForces, jax.Array, jax.Array, jax.Array]:
    """Forces on the wheels, new sinkage m, load N and its stiffness N/m, all `[4]`.

    Soil and suspension share the depth: one Newton step a sub-step towards the sinkage at which
    their forces agree. Rigid ground leaves all of it to the suspension.
    """
    vehicle, soil = params.vehicle, stiffened(params, wheels.soil)
    wheel = Wheel(vehicle.wheel_radius, vehicle.wheel_width)
    spin = history.wheel_speed
    motion = history.sinkage, ahead, drift, spin, rut
    in_soil = soil_forces(wheel, soil, params.contact, *motion, QUADRATURE_NODES)
    # Normal force grows about like sinkage to the power n + 1/2 (Bekker, wheel on flat ground).
    sunk = jnp.maximum(history.sinkage - rut, LEAST_SINKAGE)
    yielding = (soil.n + 0.5) * in_soil.normal / sunk
    together = press.stiffness + yielding
    together = jnp.where(together > 0, together, 1.0)
    wanted = press.stiffness * press.depth - in_soil.normal + yielding * history.sinkage
    sinkage = jnp.where(wheels.soft, jnp.maximum(wanted / together, 0.0), 0.0)
    load = press.stiffness * jnp.maximum(press.depth - sinkage, 0.0)
    rate = press.stiffness * jnp.where(wheels.soft, yielding / together, 1.0)

    friction = jnp.minimum(wheels.friction, vehicle.tyre_friction)
    on_rock = rigid_forces(wheel, friction, load, ahead, drift, spin, ADHESION_SPEED)
    # Soil shears under the load that is really on it, whatever the sinkage says for now.
    loaded = jnp.minimum(load / jnp.maximum(in_soil.normal, 1.0), 1.0)
    ground = jax.tree.map(lambda a, b: jnp.where(wheels.soft, loaded * a, b), in_soil, on_rock)
    return ground, sinkage, load, rate


def stiffened(params: SimulatorParams, soil: Soil) -> Soil:
    """The soil `[...]` that the wheels meet, of one of the map's."""
    return replace(
        soil,
        kc=params.stiffening * soil.kc,
        kphi=params.stiffening * soil.kphi,
    )


def _drivetrain(
    vehicle: Vehicle, pedal: jax.Array, wheel_speed: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Driving torque on each wheel, N m, and braking torque per wheel speed, N m s/rad `[4]`.

    Open differentials: all wheels get the same torque, limited by power at their mean speed;
    the engine fades out over the upper half of its speed range.
    """
    mean_speed = jnp.maximum(jnp.abs(jnp.mean(wheel_speed)), 1.0)
    torque = jnp.minimum(vehicle.wheel_torque, vehicle.wheel_power / mean_speed)
    torque = torque * jnp.clip(2 - 2 * mean_speed / vehicle.wheel_speed_limit, 0.0, 1.0)
    brake = vehicle.brake_torque / (jnp.abs(wheel_speed) + SPIN_FLOOR)
    return jnp.maximum(pedal, 0.0) * torque, jnp.maximum(-pedal, 0.0) * brake


def _tangents(normal: Vector, cos: jax.Array, sin: jax.Array) -> tuple[Vector, Vector]:
    """Directions in the tangent plane along and to the left of a heading in the body."""
    rise = normal.x * cos + normal.y * sin
    along = Vector(cos - rise * normal.x, sin - rise * normal.y, -rise * normal.z).normalised()
    return along, normal.cross(along)


def _hull_contact(
    vehicle: Vehicle, twist: Twist, hull: Touch, centre: Vector, seconds: float
) -> ContactForce:
    """The chassis on the ground: a heavily damped spring, and friction.

    Soil gives way under the belly, as Chrono's SCM feels wheels only, but not under a roof.
    """
    arm, n = hull.point.plus(centre, -1.0), hull.normal
    forward, left = _tangents(n, jnp.ones(1), jnp.zeros(1))
    velocity = velocity_at(twist, arm)
    stiffness = 2 * vehicle.mass / HULL_SECONDS**2
    rate = stiffness * (seconds + HULL_SECONDS)
    gives_way = hull.soft & (n.z > LEAST_UPRIGHT)
    load = stiffness * jnp.minimum(hull.depth, HULL_DEPTH) - rate * velocity.dot(n)
    load = jnp.minimum(load, HULL_LOAD * vehicle.mass * GRAVITY)
    pressing = (hull.depth > 0) & ~gives_way & (load > 0)
    load, rate = jnp.where(pressing, load, 0.0), jnp.where(pressing, rate, 0.0)
    ahead, drift = velocity.dot(forward), velocity.dot(left)
    grip = HULL_FRICTION * load * jax.lax.rsqrt(ahead**2 + drift**2 + ADHESION_SPEED**2)
    return ContactForce.of(
        arm,
        Push(n, load, rate),
        Push(forward, -grip * ahead, grip),
        Push(left, -grip * drift, grip),
    )


def _advance_pose(
    vehicle: Vehicle, body: _Body, axes: Axes, centre: Vector, twist: Twist, seconds: float
) -> _Body:
    """Moves the centre of mass by the new velocity and turns the body about it."""
    turn = geometry.rotation_from_vector(seconds * twist.angular.stacked())
    quaternion = geometry.compose(jaxlie.SO3(body.quaternion), turn).wxyz
    at_centre = axes.to_world(centre.plus(twist.linear, seconds))
    # Of the large number that a place may be, only one sum is rounded.
    gone = at_centre.plus(Axes.from_quaternion(quaternion).to_world(centre), -1.0)
    position = body.position.plus(gone)
    inertia = Vector.of(vehicle.inertia)
    return _Body(position, quaternion, turned(twist, inertia, Axes.from_quaternion(turn.wxyz)))
