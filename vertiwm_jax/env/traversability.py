"""How ground tilts and touches a vehicle on it, and how hard it is to drive on."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.mechanics.vehicle import Vehicle

SLOPE_SCALE = 0.4
TWIST_SCALE = 0.2
CROWN_SCALE = 0.2  # m


@struct.dataclass
class Footprint:
    """The ground below a vehicle, leaves `[...]`.

    mean: height under the wheels, m.
    crown: height of the ground between the wheels above that, which the belly touches, over 0.2 m.
    rise, bank: slopes from rear to front and from right to left, over 0.4.
    twist: difference of the slopes at both axles, which lifts wheels, over 0.2.
    """

    mean: jax.Array
    crown: jax.Array
    rise: jax.Array
    bank: jax.Array
    twist: jax.Array


def places(
    vehicle: Vehicle, xy: jax.Array | np.ndarray, heading: jax.Array | np.ndarray
) -> jax.Array:
    """The middles and wheels of vehicles at `[..., 2]`, m, with `[...]` heading: `[5, ..., 2]`."""
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    forward = jnp.stack([cos, sin], axis=-1) * vehicle.wheelbase / 2
    left = jnp.stack([-sin, cos], axis=-1) * vehicle.track / 2
    corners = (forward + left, forward - left, -forward + left, -forward - left)
    return jnp.stack([xy, *(xy + corner for corner in corners)])


def footprint(vehicle: Vehicle, heights: jax.Array) -> Footprint:
    """Of heights `[5, ...]`, m, at `places`."""
    middle, fl, fr, rl, rr = heights
    mean = (fl + fr + rl + rr) / 4
    return Footprint(
        mean=mean,
        crown=(middle - mean) / CROWN_SCALE,
        rise=(fl + fr - rl - rr) / (2 * vehicle.wheelbase * SLOPE_SCALE),
        bank=(fl + rl - fr - rr) / (2 * vehicle.track * SLOPE_SCALE),
        twist=(fl + rr - fr - rl) / (2 * vehicle.track * TWIST_SCALE),
    )


@dataclass(frozen=True)
class TraversabilityCost:
    """The difficulty of ground.

    bank, rise, twist, crown: weights of the squares of the parts of a `Footprint`.
    tolerated: bank and rise that cost nothing.
    """

    bank: float = 1.0
    rise: float = 1.45
    twist: float = 2.3
    crown: float = 1.1
    tolerated: float = 0.4

    def __call__(
        self, crown: jax.Array, rise: jax.Array, bank: jax.Array, twist: jax.Array
    ) -> jax.Array:
        """`[...]`, 0 on ground that is level."""
        return (
            self.bank * jnp.maximum(jnp.abs(bank) - self.tolerated, 0.0) ** 2
            + self.rise * jnp.maximum(jnp.abs(rise) - self.tolerated, 0.0) ** 2
            + self.twist * twist**2
            + self.crown * jnp.maximum(crown, 0.0) ** 2
        )
