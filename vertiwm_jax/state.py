"""The pytrees that flow through every model: state and command.

Every array may carry any number of leading batch axes, written `...`.
"""

from typing import Literal, Self

import jax
import jax.numpy as jnp
import jaxlie
from flax import struct

from vertiwm_jax import geometry

STEP_SECONDS = 0.1
"""The sampling interval of the paper: one transition lasts 0.1 s."""
Turn = Literal["steering", "yaw_rate"]
"""What the second of two commands is: a front-wheel angle, rad, or a yaw rate, rad/s."""


@struct.dataclass
class VehicleState:
    """The paper's 12-D state x = [p; eta; v; omega] (Sec. III-A).

    position: `[..., 3]` p_world, m, of the body origin (between the wheel centers).
    rpy: `[..., 3]` roll, pitch, yaw, rad; R = Rz Ry Rx, pitch > 0 is nose down.
    velocity: `[..., 3]` v_body, m/s; x forward, y left, z up.
    angular_velocity: `[..., 3]` omega_body, rad/s.
    """

    position: jax.Array
    rpy: jax.Array
    velocity: jax.Array
    angular_velocity: jax.Array

    @property
    def pose(self) -> jaxlie.SE3:
        """T_world_body."""
        rotation = geometry.rotation_from_rpy(self.rpy)
        return jaxlie.SE3.from_rotation_and_translation(rotation, self.position)

    @property
    def vector(self) -> jax.Array:
        """`[..., 12]` the concatenated state."""
        parts = (self.position, self.rpy, self.velocity, self.angular_velocity)
        return jnp.concatenate(parts, axis=-1)

    @classmethod
    def from_vector(cls, vector: jax.Array) -> Self:
        """`[..., 12]` to a state; the inverse of `vector`."""
        return cls(vector[..., 0:3], vector[..., 3:6], vector[..., 6:9], vector[..., 9:12])


@struct.dataclass
class Command:
    """What a driver asks for during one step (the paper's u_t).

    speed: `[...]` commanded forward speed, m/s; negative backwards.
    steering: `[...]` front-wheel angle, rad, left positive; of a skid-steered vehicle the yaw rate,
        rad/s.
    """

    speed: jax.Array
    steering: jax.Array

    @classmethod
    def from_vector(cls, vector: jax.Array) -> Self:
        """`[..., 2]` speed and steering to a command."""
        return cls(vector[..., 0], vector[..., 1])

    @property
    def vector(self) -> jax.Array:
        """`[..., 2]` speed and steering."""
        return jnp.stack([self.speed, self.steering], axis=-1)
