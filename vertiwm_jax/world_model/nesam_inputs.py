"""What NeSAM's network reads of a step of physics, and how the same step looks in a mirror."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.mechanics.simulator import SimulatorHistory
from vertiwm_jax.mechanics.vehicle import GRAVITY, Vehicle
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.world_model import motion
from vertiwm_jax.world_model.normalization import LOCAL, Normalization

LARGEST = 8.0
"""Where features are cut off, lest a crash blind the network for a whole window."""
DEPTH = 0.1
"""Typical depth of a track in soil, m."""
TRAVEL = 0.05
"""Typical travel of a wheel, m."""
FIRM = 1e6
"""Stress, Pa, of a middling soil at a depth of 1 m."""

TWIST_SIGNS = np.array([1, -1, 1, -1, 1, -1], np.float32)
"""What a mirror across the vehicle's vertical plane makes of increments and of velocities."""
MOTION_SIGNS = np.tile(TWIST_SIGNS, 2)
"""The same of `motion.transition` and `motion.difference`."""
_BODY_SIGNS = np.concatenate(
    [[-1, 1], TWIST_SIGNS, [1, -1], MOTION_SIGNS, MOTION_SIGNS, [-1]], dtype=np.float32
)
_WHEEL_SIGNS = np.array([1, 1, 1, 1, 1, 1, -1, 1, 1, 1, 1, 1, 1, -1], np.float32)
_OTHER_SIDE = np.array([1, 0, 3, 2])

SIZE = _BODY_SIGNS.size + 4 * _WHEEL_SIGNS.size
"""Numbers in `StepFeatures.flat`."""


class StepFeatures(NamedTuple):
    """Of any number of steps `[...]`, each about 1.

    body: `[..., 35]` state without place and heading, command, what physics proposes, how wrong
        it was in the step before, and the steering angle.
    wheels: `[..., 4, 14]` slip, travel, sinkage, rut, the three forces, and the contact: soft,
        edge, friction, stiffness of the soil, depth, and the normal forward and to the left.
    """

    body: jax.Array
    wheels: jax.Array

    @property
    def both(self) -> jax.Array:
        """`[2, ..., SIZE]` what the network reads, as it is and in a mirror."""
        return jnp.stack([self.flat, self.mirrored.flat])

    @property
    def flat(self) -> jax.Array:
        """`[..., SIZE]`."""
        wheels = self.wheels.reshape(*self.wheels.shape[:-2], -1)
        return jnp.clip(jnp.concatenate([self.body, wheels], axis=-1), -LARGEST, LARGEST)

    @property
    def mirrored(self) -> "StepFeatures":
        """Left and right exchanged."""
        return StepFeatures(
            body=self.body * _BODY_SIGNS, wheels=self.wheels[..., _OTHER_SIDE, :] * _WHEEL_SIGNS
        )

    @classmethod
    def of(
        cls,
        constants: Normalization,
        correction_scale: jax.Array,
        vehicle: Vehicle,
        expected: VehicleState,
        state: VehicleState,
        command: Command,
        physics: VehicleState,
        memory: SimulatorHistory,
    ) -> "StepFeatures":
        """Of steps `[...]` from `state` to what physics makes of it, with its `memory`.

        expected: what physics had made of `state`. Of the constants only deviations are used:
        with the means, a mirror would not be a change of signs.
        """
        body = [
            state.vector[..., LOCAL] / constants.state_deviation,
            command.vector / constants.command_deviation,
            motion.transition(state, physics) / constants.transition_deviation,
            motion.difference(expected, state) / correction_scale,
            memory.steering[..., None] / vehicle.steering_limit,
        ]
        touch, soil = memory.wheels, memory.wheels.soil
        modulus = jnp.where(touch.soft, soil.kphi + soil.kc / vehicle.wheel_width, FIRM)
        weight = vehicle.mass * GRAVITY / 4
        wheels = [
            jnp.arcsinh(vehicle.wheel_radius * memory.wheel_speed - physics.velocity[..., :1]),
            (memory.travel - vehicle.free_travel) / TRAVEL,
            memory.sinkage / DEPTH,
            jnp.concatenate([jnp.zeros_like(memory.rut), memory.rut], axis=-1) / DEPTH,
            *jnp.moveaxis(memory.force / weight, -1, 0),
            jnp.where(touch.soft, 1.0, 0.0),
            jnp.where(touch.edge, 1.0, 0.0),
            touch.friction,
            jnp.log(modulus / FIRM),
            touch.depth / DEPTH,
            touch.normal.x,
            touch.normal.y,
        ]
        return cls(jnp.concatenate(body, axis=-1), jnp.stack(wheels, axis=-1))
