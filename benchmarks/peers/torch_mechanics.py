"""The built-in simulator in PyTorch: `vertiwm_jax.mechanics.simulator` over a batch."""

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.peers import torch_motion as motion
from benchmarks.peers.torch_query import Ground
from benchmarks.peers.torch_touch import Touch, touch
from benchmarks.peers.torch_wheel import WheelForces, gauss_legendre, rigid_forces, scm_forces
from vertiwm_jax.mechanics.drivetrain import SPIN_FLOOR
from vertiwm_jax.mechanics.simulator import CREEP_SPEED
from vertiwm_jax.mechanics.suspension import (
    ADHESION_SPEED,
    CLIMB_SPEED,
    HULL_DEPTH,
    HULL_FRICTION,
    HULL_LOAD,
    HULL_SECONDS,
    LARGEST_LOAD,
    LEAST_SINKAGE,
    LEAST_UPRIGHT,
)
from vertiwm_jax.mechanics.vehicle import GRAVITY
from vertiwm_jax.state import STEP_SECONDS

_STEERED = torch.tensor([1.0, 1.0, 0.0, 0.0])


class Memory(NamedTuple):
    """As `mechanics.simulator.SimulatorHistory`, with a leading batch axis."""

    wheel_speed: Tensor
    travel: Tensor
    steering: Tensor
    sinkage: Tensor
    rut: Tensor
    wheels: Touch
    force: Tensor


class Body(NamedTuple):
    """Chassis `[B, ...]`: origin, m, and quaternion; velocity of the centre of mass and angular
    velocity, body components."""

    position: Tensor
    quaternion: Tensor
    linear: Tensor
    angular: Tensor


class Contacts(NamedTuple):
    """Forces `[B, C]` N along directions at arms `[B, C, 3]` m from the centre of mass, and the
    damping `[B, C]` N s/m with which they answer to motion."""

    direction: Tensor
    arm: Tensor
    force: Tensor
    damping: Tensor


class Simulator:
    """Steps of 0.1 s, over a few sub-steps; vehicle and contact hold floats and tensors."""

    def __init__(self, vehicle: Any, contact: Any, stiffening: float, substeps: int):
        self.vehicle, self.contact = vehicle, contact
        self.substeps, self.seconds = substeps, STEP_SECONDS / substeps
        self.quadrature = gauss_legendre(int(contact.nodes))
        self.masses = torch.diag(torch.cat([torch.full((3,), vehicle.mass), vehicle.inertia]))
        self.scaled = torch.tensor([stiffening, stiffening, 1.0, 1.0, 1.0, 1.0])

    def init(self, ground: Ground, state: Tensor) -> Memory:
        """Wheels roll without slip, stand where the springs carry the weight, steer ahead."""
        vehicle, batch = self.vehicle, len(state)
        load = vehicle.mass * GRAVITY / 4
        none = torch.zeros(batch, 4)
        travel = vehicle.free_travel + (load - vehicle.wheel_weight) / vehicle.spring + none
        rotation = motion.matrix(motion.quaternion(state[:, 3:6]))
        wheels, _ = touch(vehicle, ground, state[:, :3], rotation, travel, none, none)
        return Memory(
            wheel_speed=state[:, 6:7] / vehicle.wheel_radius + none,
            travel=travel,
            steering=torch.zeros(batch),
            sinkage=none,
            rut=torch.zeros(batch, 2),
            wheels=wheels,
            force=torch.tensor([load, 0.0, 0.0]).expand(batch, 4, 3),
        )

    def step(
        self, ground: Ground, memory: Memory, state: Tensor, command: Tensor
    ) -> tuple[Tensor, Memory]:
        """States `[B, 12]` and commands `[B, 2]` to the next states."""
        centre, angular = self.vehicle.centre_of_mass, state[:, 9:]
        linear = state[:, 6:9] + _cross(angular, centre)
        position = state[:, :3].contiguous()
        body = Body(position, motion.quaternion(state[:, 3:6]), linear, angular.contiguous())
        for _ in range(self.substeps):
            body, memory = self.substep(ground, body, memory, command)
        velocity = body.linear - _cross(body.angular, centre)
        parts = (body.position, motion.rpy(body.quaternion), velocity, body.angular)
        return torch.cat(parts, dim=-1), memory

    def substep(
        self, ground: Ground, body: Body, memory: Memory, command: Tensor
    ) -> tuple[Body, Memory]:
        """Body and memory after `seconds`."""
        vehicle, seconds, radius = self.vehicle, self.seconds, self.vehicle.wheel_radius
        rotation = motion.matrix(body.quaternion)
        forward = body.linear[:, 0]
        pedal = (vehicle.speed_gain * (command[:, 0] - forward)).clamp(-1.0, 1.0)
        target = command[:, 1].clamp(-vehicle.steering_limit, vehicle.steering_limit)
        turn = vehicle.steering_rate * seconds
        steering = memory.steering + (target - memory.steering).clamp(-turn, turn)

        steer = steering[:, None] * _STEERED
        wheels, hull = touch(
            vehicle, ground, body.position, rotation, memory.travel, steer, memory.sinkage
        )
        n, arm = wheels.normal, wheels.point - vehicle.centre_of_mass
        rolling, lateral = _tangents(n, torch.cos(steer), torch.sin(steer))
        velocity = _velocity_at(body.linear, body.angular, arm)
        ahead, drift = _dot(velocity, rolling), _dot(velocity, lateral)

        droop, depth, upright, stiffness, carrying = self._suspend(
            wheels, memory.travel, memory.sinkage * wheels.soft, _dot(velocity, n)
        )
        support, sinkage, load, rate = self._support(wheels, depth, stiffness, memory, ahead, drift)

        sliding = (ahead - radius * memory.wheel_speed) ** 2 + drift**2 + CREEP_SPEED**2
        still = (CREEP_SPEED / ADHESION_SPEED * load) ** 2 + 1.0
        grip = (support.torque / radius) ** 2 + support.lateral**2 + still
        grip = torch.sqrt(grip / sliding)

        drive, brake = self._drivetrain(pedal, memory.wheel_speed)
        inertia = vehicle.wheel_inertia + seconds * (brake + radius**2 * grip)
        spin_up = seconds * (drive - brake * memory.wheel_speed - support.torque) / inertia
        traction = support.longitudinal + radius * grip * spin_up
        traction_rate = grip * (1 - seconds * radius**2 * grip / inertia)

        on_hull = self._hull_contacts(body, hull)
        contacts = Contacts(
            direction=torch.cat([n, rolling, lateral, on_hull.direction], dim=1),
            arm=torch.cat([arm, arm, arm, on_hull.arm], dim=1),
            force=torch.cat([load, traction, support.lateral, on_hull.force], dim=1),
            damping=torch.cat([seconds * rate, traction_rate, grip, on_hull.damping], dim=1),
        )
        linear, angular = self._advance_twist(body, -GRAVITY * rotation[:, 2], contacts)

        gained = _velocity_at(linear, angular, arm) - velocity
        pushed = depth - sinkage - seconds * _dot(gained, n)
        travel = droop + torch.where(carrying, pushed / upright, 0.0)
        fresh = 1 - torch.exp(-seconds * forward.abs() / vehicle.wheelbase)
        memory = Memory(
            wheel_speed=memory.wheel_speed
            + spin_up
            + seconds * radius * grip * _dot(gained, rolling) / inertia,
            travel=torch.clamp(travel, vehicle.free_travel - radius, vehicle.free_travel + radius),
            steering=steering,
            sinkage=torch.where(wheels.edge, memory.sinkage, sinkage),
            rut=memory.rut + fresh[:, None] * (sinkage[:, :2] - memory.rut),
            wheels=wheels,
            force=torch.stack([load, traction, support.lateral], dim=-1),
        )
        return self._advance_pose(body, rotation, linear, angular), memory

    def _suspend(
        self, wheels: Touch, travel: Tensor, sinkage: Tensor, leaving: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """What `suspension.WheelSupport` holds, in its order, all `[B, 4]`."""
        vehicle, seconds = self.vehicle, self.seconds
        upright = wheels.normal[..., 2].clamp(min=LEAST_UPRIGHT)
        damping = vehicle.damper / seconds
        stiffness = vehicle.spring + damping
        relaxed = vehicle.spring * vehicle.free_travel + damping * travel - vehicle.wheel_weight
        droop = relaxed / stiffness
        stepped_in = torch.minimum(wheels.depth, sinkage + CLIMB_SPEED * seconds)
        depth = stepped_in + upright * (travel - droop) - seconds * leaving
        carrying = (wheels.normal[..., 2] > LEAST_UPRIGHT) & (depth > 0)
        largest = LARGEST_LOAD * vehicle.mass * GRAVITY
        pressed = (depth - sinkage).clamp(min=LEAST_SINKAGE)
        stiffness = torch.minimum(stiffness / upright**2, largest / pressed) * carrying
        return droop, depth, upright, stiffness, carrying

    def _support(
        self,
        wheels: Touch,
        depth: Tensor,
        stiffness: Tensor,
        memory: Memory,
        ahead: Tensor,
        drift: Tensor,
    ) -> tuple[WheelForces, Tensor, Tensor, Tensor]:
        """Forces on the wheels, sinkage, m, load, N, and its stiffness, N/m, all `[B, 4]`."""
        vehicle, spin = self.vehicle, memory.wheel_speed
        soil = wheels.soil * self.scaled
        rut = torch.cat([torch.zeros_like(memory.rut), memory.rut], dim=1)
        in_soil = scm_forces(
            *(vehicle, self.contact, soil, memory.sinkage, ahead, drift, spin, rut),
            quadrature=self.quadrature,
        )
        sunk = (memory.sinkage - rut).clamp(min=LEAST_SINKAGE)
        yielding = (soil[..., 2] + 0.5) * in_soil.normal / sunk
        together = stiffness + yielding
        together = torch.where(together > 0, together, 1.0)
        wanted = stiffness * depth - in_soil.normal + yielding * memory.sinkage
        sinkage = (wanted / together).clamp(min=0.0) * wheels.soft
        load = stiffness * (depth - sinkage).clamp(min=0.0)
        rate = stiffness * torch.where(wheels.soft, yielding / together, 1.0)

        friction = wheels.friction.clamp(max=vehicle.tyre_friction)
        on_rock = rigid_forces(
            vehicle.wheel_radius, friction, load, ahead, drift, spin, ADHESION_SPEED
        )
        loaded = (load / in_soil.normal.clamp(min=1.0)).clamp(max=1.0)
        pairs = zip(in_soil, on_rock, strict=True)
        forces = WheelForces(*(torch.where(wheels.soft, loaded * a, b) for a, b in pairs))
        return forces, sinkage, load, rate

    def _drivetrain(self, pedal: Tensor, wheel_speed: Tensor) -> tuple[Tensor, Tensor]:
        """Driving torque `[B, 1]`, N m, and braking torque per wheel speed `[B, 4]`, N m s/rad."""
        vehicle = self.vehicle
        mean_speed = wheel_speed.mean(1).abs().clamp(min=1.0)
        torque = (vehicle.wheel_power / mean_speed).clamp(max=vehicle.wheel_torque)
        torque = torque * (2 - 2 * mean_speed / vehicle.wheel_speed_limit).clamp(0.0, 1.0)
        brake = vehicle.brake_torque / (wheel_speed.abs() + SPIN_FLOOR)
        return (pedal.clamp(min=0.0) * torque)[:, None], (-pedal).clamp(min=0.0)[:, None] * brake

    def _hull_contacts(self, body: Body, hull: Touch) -> Contacts:
        """The chassis on the ground, `[B, 3]`: a heavily damped spring, and friction."""
        vehicle, seconds = self.vehicle, self.seconds
        arm, n = hull.point - vehicle.centre_of_mass, hull.normal
        forward, left = _tangents(n, torch.ones_like(hull.depth), torch.zeros_like(hull.depth))
        velocity = _velocity_at(body.linear, body.angular, arm)
        stiffness = 2 * vehicle.mass / HULL_SECONDS**2
        rate = stiffness * (seconds + HULL_SECONDS)
        gives_way = hull.soft & (n[..., 2] > LEAST_UPRIGHT)
        load = stiffness * hull.depth.clamp(max=HULL_DEPTH) - rate * _dot(velocity, n)
        load = load.clamp(max=HULL_LOAD * vehicle.mass * GRAVITY)
        pressing = (hull.depth > 0) & ~gives_way & (load > 0)
        load = load * pressing
        ahead, drift = _dot(velocity, forward), _dot(velocity, left)
        grip = HULL_FRICTION * load * torch.rsqrt(ahead**2 + drift**2 + ADHESION_SPEED**2)
        return Contacts(
            direction=torch.cat([n, forward, left], dim=1),
            arm=arm.expand(-1, 3, -1),
            force=torch.cat([load, -grip * ahead, -grip * drift], dim=1),
            damping=torch.cat([rate * pressing, grip, grip], dim=1),
        )

    def _advance_twist(
        self, body: Body, gravity: Tensor, contacts: Contacts
    ) -> tuple[Tensor, Tensor]:
        """Velocities `[B, 3]` after a linearly implicit Euler step, as `newton_euler`."""
        vehicle, seconds = self.vehicle, self.seconds
        moments = torch.linalg.cross(contacts.arm, contacts.direction)
        jacobian = torch.cat([contacts.direction, moments], dim=-1)
        weighted = (seconds * contacts.damping)[..., None] * jacobian
        matrix = self.masses + weighted.mT @ jacobian
        pushed = (contacts.force[..., None] * jacobian).sum(1)
        weight = torch.cat([vehicle.mass * gravity, torch.zeros_like(gravity)], dim=-1)
        change = torch.linalg.solve(matrix, seconds * (pushed + weight))
        return body.linear + change[:, :3], body.angular + change[:, 3:]

    def _advance_pose(self, body: Body, rotation: Tensor, linear: Tensor, angular: Tensor) -> Body:
        """Moves the centre of mass by the new velocity and turns the body about it."""
        centre, inertia = self.vehicle.centre_of_mass, self.vehicle.inertia
        turn = motion.exp_rotation(self.seconds * angular)
        quaternion = F.normalize(motion.multiply(body.quaternion, turn), dim=-1)
        moved = torch.einsum("bij,bj->bi", rotation, centre + self.seconds * linear)
        position = body.position + moved - motion.matrix(quaternion) @ centre
        back = motion.conjugate(turn)
        linear = motion.rotate(back, linear)
        angular = motion.rotate(back, inertia * angular) / inertia
        return Body(position, quaternion, linear, angular)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(a, b.expand_as(a))


def _velocity_at(linear: Tensor, angular: Tensor, arm: Tensor) -> Tensor:
    """Velocity `[B, C, 3]` of body points at arms `[B, C, 3]` from the centre of mass, m/s."""
    return linear[:, None] + torch.linalg.cross(angular[:, None].expand_as(arm), arm)


def _tangents(normal: Tensor, cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor]:
    """Directions `[B, C, 3]` in the tangent plane along and to the left of a heading `[B, C]`."""
    heading = torch.stack([cos, sin, torch.zeros_like(cos)], dim=-1)
    along = heading - _dot(heading, normal)[..., None] * normal
    along = F.normalize(along, dim=-1)
    return along, torch.linalg.cross(normal, along)
