"""What wheels find of tracks, and leave."""

from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.mechanics.contact import GroundContact
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.terrain.ruts import CELL_METERS, Ruts
from vertiwm_jax.vector import Axes, Vector

_ACROSS = np.array([-0.5, -1 / 6, 1 / 6, 0.5], np.float32)[:, None]
_ALONG = np.array([0.0, 0.5, 1.0], np.float32)[:, None, None]


class Tracks(NamedTuple):
    """Of the four wheels, seen from above in the world frame: x, y of points across each wheel.

    bottom: `[4 points, 4, 2]` m, below the hub; travel: `[4, 2]` m/s, its velocity along the
    rolling direction.
    """

    bottom: jax.Array
    travel: jax.Array

    @classmethod
    def of(
        cls,
        vehicle: Vehicle,
        position: Vector,
        axes: Axes,
        wheels: GroundContact,
        rolling: Vector,
        ahead: jax.Array,
    ) -> Self:
        """rolling: unit vectors `[4]` in the body; ahead: `[4]` m/s along them."""
        below = _from_above(position.plus(axes.to_world(wheels.point)))
        along = _from_above(axes.to_world(rolling))
        left = jnp.stack([-along[:, 1], along[:, 0]], axis=-1)
        across = jnp.reshape(vehicle.wheel_width, (-1, 1)) * left
        return cls(below + _ACROSS[..., None] * across, ahead[:, None] * along)

    def found(self, ruts: Ruts, vehicle: Vehicle, sinkage: jax.Array) -> jax.Array:
        """`[4]` m, how deep the ruts are where the wheels, `[4]` m deep, enter the soil.

        Nearer to the wheel is what it has pressed itself.
        """
        entry = jnp.sqrt(2 * vehicle.wheel_radius * sinkage)
        entry = jnp.maximum(entry, 1.5 * CELL_METERS)[:, None]
        speed = jnp.linalg.norm(self.travel, axis=-1, keepdims=True)
        moving = speed > 1e-3
        ahead = jnp.where(moving, self.travel / jnp.where(moving, speed, 1.0), 0.0)
        x, y = jnp.moveaxis(self.bottom + entry * ahead, -1, 0)
        return jnp.mean(ruts.at(x, y), axis=0)

    def left(self, ruts: Ruts, sinkage: jax.Array, seconds: float) -> Ruts:
        """The ruts after the wheels, `[4]` m deep, have rolled for so long."""
        passed = self.bottom + seconds * _ALONG[..., None] * self.travel
        depth = jnp.broadcast_to(sinkage, passed.shape[:-1])
        return ruts.pressed(passed.reshape(-1, 2), depth.ravel())


def _from_above(v: Vector) -> jax.Array:
    return jnp.stack([v.x, v.y], axis=-1)
