"""The built-in simulator: a four-wheeled vehicle on rigid, soft and mixed ground.

A stand-in for a multibody simulator at a ten-thousandth of its cost, differentiable throughout.
Each 0.1 s command is held over a few sub-steps of a linearly implicit integrator: springs,
dampers, tyre friction, wheel spin and soil are stiff, and all of them act on the new velocity.
Wheels carry spin inertia but no mass of their own: a wheel is where the ground, or the droop of
its damper, puts it.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from flax import struct

from vertiwm_jax import geometry
from vertiwm_jax.mechanics.newton_euler import ContactForce, Twist, advance_twist, velocity_at
from vertiwm_jax.mechanics.vector import Axes, Vector
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.mechanics.wheel import Contact, Wheel, forces, rigid_forces
from vertiwm_jax.state import STEP_SECONDS, Command, VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap

GRAVITY = 9.81
ADHESION_SPEED = 0.1
"""Slip speed, m/s, at which friction has reached 70 % of its limit."""
SPIN_FLOOR = 0.5
"""Wheel speed, rad/s, below which a locked brake lets a wheel creep."""
TREAD_ANGLES = (-0.7, -0.35, 0.0, 0.35, 0.7)
"""Where a wheel's rims are tested against the ground, rad from straight down."""
CONTACT_SOFTNESS = 0.005
"""Depth, m, over which neighbouring points of a tread share a contact."""
NODES = 4
"""Quadrature nodes on each side of the stress peak: within 1 % of the converged force."""
LEAST_SINKAGE = 1e-3
LARGEST_LOAD = 2.5
"""Largest normal force on one wheel, in vehicle weights."""
LEAST_UPRIGHT = 0.2
"""Cosine between body and ground normal below which wheels no longer carry."""
BELLY_STIFFNESS = 5e5
BELLY_DAMPING = 2e4
BELLY_FRICTION = 0.5


@struct.dataclass
class SimulatorParams:
    vehicle: Vehicle
    contact: Contact


@struct.dataclass
class SimulatorHistory:
    """What the 12-D state does not say.

    wheel_speed: `[4]` rad/s, positive forward.
    travel: `[4]` m, height of the wheel centres in the body.
    steering: `[]` rad, angle of the front wheels.
    sinkage: `[4]` m, of the wheels in soil; 0 on rigid ground.
    rut: `[2]` m, depth of the tracks that the rear wheels find, left and right.
    """

    wheel_speed: jax.Array
    travel: jax.Array
    steering: jax.Array
    sinkage: jax.Array
    rut: jax.Array


class _Body(NamedTuple):
    """Pose and twist of the chassis while it is integrated."""

    position: Vector
    quaternion: jax.Array
    twist: Twist


@dataclass(frozen=True)
class Simulator:
    """The dynamics `init` / `step` of the built-in simulator; `substeps` per 0.1 s."""

    substeps: int = 5

    def init(
        self, params: SimulatorParams, terrain: TerrainMap, state: VehicleState
    ) -> SimulatorHistory:
        """Wheels roll without slip, stand where the springs carry the weight, steer ahead."""
        vehicle = params.vehicle
        rolling = state.velocity[0] / vehicle.wheel_radius
        load = vehicle.mass * GRAVITY / 4 - vehicle.wheel_weight
        return SimulatorHistory(
            wheel_speed=jnp.full(4, rolling),
            travel=vehicle.free_travel + load / vehicle.spring,
            steering=jnp.zeros(()),
            sinkage=jnp.zeros(4),
            rut=jnp.zeros(2),
        )

    def step(
        self,
        params: SimulatorParams,
        terrain: TerrainMap,
        history: SimulatorHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, SimulatorHistory]:
        centre = Vector.of(params.vehicle.centre_of_mass)
        angular = Vector.of(state.angular_velocity)
        linear = Vector.of(state.velocity).plus(angular.cross(centre))
        quaternion = geometry.rotation_from_rpy(state.rpy).wxyz
        body = _Body(Vector.of(state.position), quaternion, Twist(linear, angular))

        def substep(
            carry: tuple[_Body, SimulatorHistory], _: None
        ) -> tuple[tuple[_Body, SimulatorHistory], None]:
            seconds = STEP_SECONDS / self.substeps
            return _substep(params, terrain, *carry, command, seconds), None

        (body, history), _ = jax.lax.scan(substep, (body, history), None, length=self.substeps)
        linear, angular = body.twist
        return VehicleState(
            position=body.position.stacked(),
            rpy=geometry.rpy_from_rotation(jaxlie.SO3(body.quaternion)),
            velocity=linear.plus(angular.cross(centre), -1.0).stacked(),
            angular_velocity=angular.stacked(),
        ), history


def _substep(
    params: SimulatorParams,
    terrain: TerrainMap,
    body: _Body,
    history: SimulatorHistory,
    command: Command,
    seconds: float,
) -> tuple[_Body, SimulatorHistory]:
    vehicle = params.vehicle
    axes = Axes.from_quaternion(body.quaternion)
    centre = Vector.of(vehicle.centre_of_mass)

    # Driver: proportional speed control and rate-limited steering.
    forward = body.twist.linear.x
    pedal = jnp.clip(vehicle.speed_gain * (command.speed - forward), -1.0, 1.0)
    target = jnp.clip(command.steering, -vehicle.steering_limit, vehicle.steering_limit)
    turn = vehicle.steering_rate * seconds
    steering = history.steering + jnp.clip(target - history.steering, -turn, turn)

    # Ground under the treads and under the belly, in one query.
    steer = jnp.concatenate([jnp.full(2, steering), jnp.zeros(2)])
    cos, sin = jnp.cos(steer), jnp.sin(steer)
    hub = Vector(vehicle.wheel_position[:, 0], vehicle.wheel_position[:, 1], history.travel)
    tread = _tread(vehicle, hub, cos, sin)
    belly = Vector.of(vehicle.belly)
    points = Vector(*(jnp.concatenate([t.ravel(), b]) for t, b in zip(tread, belly, strict=True)))
    world = body.position.plus(axes.to_world(points))
    ground = query.surface(terrain, jnp.stack([world.x, world.y], axis=-1))
    slope_x, slope_y = ground.gradient[:, 0], ground.gradient[:, 1]
    steepness = jax.lax.rsqrt(1 + slope_x**2 + slope_y**2)
    normal = axes.to_body(Vector(-slope_x * steepness, -slope_y * steepness, steepness))
    # Depth below the tangent plane: vertical depth times the normal's upward part.
    depth = (ground.height - world.z) * steepness

    treads = tread.x.size
    on_tread = lambda a: a[:treads].reshape(tread.x.shape)
    tread_depth = on_tread(depth)
    share = jax.nn.softmax(tread_depth / CONTACT_SOFTNESS, axis=0)
    centroid = lambda v: Vector(*(jnp.sum(share * c, axis=0) for c in v))
    n = centroid(Vector(*(on_tread(c) for c in normal))).normalised()
    arm = centroid(tread).plus(centre, -1.0)
    friction = jnp.sum(share * on_tread(ground.friction), axis=0)

    # Suspension: where the wheel touches, against where its damper lets it droop to.
    upright = jnp.maximum(n.z, LEAST_UPRIGHT)
    stiffness = vehicle.spring + vehicle.damper / seconds
    droop = (
        vehicle.spring * vehicle.free_travel
        + vehicle.damper / seconds * history.travel
        - vehicle.wheel_weight
    ) / stiffness
    velocity = velocity_at(body.twist, arm)
    depth_at_droop = (
        jnp.sum(share * tread_depth, axis=0)
        + upright * (history.travel - droop)
        - seconds * velocity.dot(n)
    )
    carrying = (n.z > LEAST_UPRIGHT) & (depth_at_droop > 0)
    rate = jnp.where(carrying, stiffness / upright**2, 0.0)
    hardest = LARGEST_LOAD * vehicle.mass * GRAVITY
    # Beyond it the contact yields: no wheel is thrown out of the ground it was stepped into.
    rate = jnp.minimum(rate, hardest / jnp.maximum(depth_at_droop, 1e-6))
    semantic = on_tread(ground.semantic)[len(TREAD_ANGLES)]
    soft = terrain.deformable[semantic]

    # Friction on rigid ground, in the rolling and the lateral direction of each wheel.
    along = n.x * cos + n.y * sin
    rolling = Vector(cos - along * n.x, sin - along * n.y, -along * n.z).normalised()
    lateral = n.cross(rolling)
    ahead, drift = velocity.dot(rolling), velocity.dot(lateral)

    soil = jax.tree.map(lambda leaf: leaf[semantic], terrain.soils)
    wheel = Wheel(vehicle.wheel_radius, vehicle.wheel_width)
    rut = jnp.concatenate([jnp.zeros(2), history.rut])
    in_soil = forces(
        wheel, soil, params.contact, history.sinkage, ahead, drift, history.wheel_speed, rut, NODES
    )
    # One Newton step a sub-step towards the sinkage at which soil and suspension agree.
    sunk = jnp.maximum(history.sinkage - rut, LEAST_SINKAGE)
    yielding = (soil.n + 0.5) * in_soil.normal / sunk
    wanted = rate * depth_at_droop - in_soil.normal + yielding * history.sinkage
    sinkage = jnp.where(soft, jnp.maximum(wanted / (rate + yielding + 1.0), 0.0), 0.0)
    load = rate * jnp.maximum(depth_at_droop - sinkage, 0.0)
    rate = jnp.where(soft, rate * yielding / (rate + yielding + 1.0), rate)

    on_rock = rigid_forces(
        wheel, jnp.minimum(friction, vehicle.tyre_friction), load, ahead, drift,
        history.wheel_speed, ADHESION_SPEED,
    )
    ground_force = jax.tree.map(lambda a, b: jnp.where(soft, a, b), in_soil, on_rock)
    traction, side_force, moment = (
        ground_force.longitudinal, ground_force.lateral, ground_force.torque
    )
    slip = ahead - vehicle.wheel_radius * history.wheel_speed
    # Secants: the friction that is left when slip or drift has died away is none.
    sliding = jnp.sqrt(slip**2 + drift**2 + ADHESION_SPEED**2)
    grip = jnp.sqrt((moment / vehicle.wheel_radius) ** 2 + side_force**2) / sliding

    # Wheel spin, eliminated: the traction that is left once spin has answered.
    mean_speed = jnp.mean(history.wheel_speed)
    power_limited = vehicle.wheel_power / jnp.maximum(jnp.abs(mean_speed), 1.0)
    drive = jnp.maximum(pedal, 0.0) * jnp.minimum(vehicle.wheel_torque, power_limited)
    brake = jnp.maximum(-pedal, 0.0) * vehicle.brake_torque
    brake = brake / (jnp.abs(history.wheel_speed) + SPIN_FLOOR)
    radius = vehicle.wheel_radius
    effective_inertia = vehicle.wheel_inertia + seconds * (brake + radius**2 * grip)
    free_spin = seconds * (drive - brake * history.wheel_speed - moment) / effective_inertia
    traction_rate = grip * (1 - seconds * radius**2 * grip / effective_inertia)

    contacts = [
        ContactForce(n, arm, load, rate * seconds),
        ContactForce(rolling, arm, traction + radius * grip * free_spin, traction_rate),
        ContactForce(lateral, arm, side_force, grip),
        *_belly_contact(body.twist, belly.plus(centre, -1.0), normal, depth, treads, seconds),
    ]
    gravity = Vector(axes.x.z, axes.y.z, axes.z.z).times(-GRAVITY)
    twist = advance_twist(
        body.twist, vehicle.mass, Vector.of(vehicle.inertia), gravity, contacts, seconds
    )
    change = Twist(
        twist.linear.plus(body.twist.linear, -1.0), twist.angular.plus(body.twist.angular, -1.0)
    )
    gained = velocity_at(change, arm)
    wheel_speed = (
        history.wheel_speed + free_spin + seconds * radius * grip * gained.dot(rolling) / effective_inertia
    )
    raised = jnp.where(carrying, (depth_at_droop - sinkage - seconds * gained.dot(n)) / upright, 0.0)
    travel = droop + raised

    # The rear wheels find the front ones' ruts a wheelbase later, as far as they track them.
    fresh = 1 - jnp.exp(-seconds * jnp.abs(forward) / vehicle.wheelbase)
    rut = history.rut + fresh * (sinkage[:2] - history.rut)
    history = SimulatorHistory(wheel_speed, travel, steering, sinkage, rut)
    return _advance_pose(body, axes, centre, twist, seconds), history


def _tread(vehicle: Vehicle, hub: Vector, cos: jax.Array, sin: jax.Array) -> Vector:
    """Points `[10, 4]` on the two rims of the lower half of each wheel, body components."""
    angle = jnp.repeat(jnp.array(TREAD_ANGLES), 2)[:, None]
    side = jnp.tile(jnp.array([0.5, -0.5]), len(TREAD_ANGLES))[:, None]
    ahead = vehicle.wheel_radius * jnp.sin(angle)
    left = vehicle.wheel_width * side
    return Vector(
        hub.x + ahead * cos - left * sin,
        hub.y + ahead * sin + left * cos,
        hub.z - vehicle.wheel_radius * jnp.cos(angle),
    )


def _belly_contact(
    twist: Twist, arms: Vector, normal: Vector, depth: jax.Array, first: int, seconds: float
) -> list[ContactForce]:
    """The chassis on the ground: a penalty force and friction at its deepest point."""
    deepest = jnp.argmax(depth[first:])
    pick = lambda v: Vector(*(c[deepest][None] for c in v))
    arm, n = pick(arms), pick(Vector(*(c[first:] for c in normal)))
    depth = depth[first:][deepest][None]
    velocity = velocity_at(twist, arm)
    sinking = -velocity.dot(n)
    rate = BELLY_STIFFNESS * seconds + BELLY_DAMPING
    load = BELLY_STIFFNESS * depth + rate * sinking
    pressing = (depth > 0) & (load > 0)
    rate, load = jnp.where(pressing, rate, 0.0), jnp.where(pressing, load, 0.0)
    sliding = velocity.plus(n, sinking)
    speed = jnp.sqrt(sliding.dot(sliding) + ADHESION_SPEED**2)
    grip = BELLY_FRICTION * load / speed
    forward = Vector(1 - n.x * n.x, -n.x * n.y, -n.x * n.z).normalised()
    left = n.cross(forward)
    return [
        ContactForce(n, arm, load, rate),
        ContactForce(forward, arm, -grip * sliding.dot(forward), grip),
        ContactForce(left, arm, -grip * sliding.dot(left), grip),
    ]


def _advance_pose(
    body: _Body, axes: Axes, centre: Vector, twist: Twist, seconds: float
) -> _Body:
    """Moves the centre of mass by the new velocity and turns the body about it."""
    w = twist.angular.stacked()
    rotation = jaxlie.SO3(body.quaternion) @ jaxlie.SO3.exp(seconds * w)
    quaternion = rotation.normalize().wxyz
    at_centre = body.position.plus(axes.to_world(centre.plus(twist.linear, seconds)))
    position = at_centre.plus(Axes.from_quaternion(quaternion).to_world(centre), -1.0)
    return _Body(position, quaternion, twist)
