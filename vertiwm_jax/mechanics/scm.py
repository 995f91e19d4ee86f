"""Forces on a wheel in the soil contact model (SCM) of Chrono.

The ground is a field of columns. Each is pressed down under Bekker's stress and sheared under
Janosi and Hanamoto's, as under Wong's wheel, but stress acts along the normal of the undisturbed
ground and shear in its plane: compaction resists the spin of a wheel and not its motion, and a
wheel that rolls pushes the soil ahead of its hub forwards.

Sources: Krenn and Hirzinger, "SCM, a soil contact model for planetary rover mobility analysis"
(2009); Tasora et al., "A deformable terrain model in multi-domain dynamics using elastoplastic
constraints" (2019); SCMTerrain of Chrono 9.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.mechanics.wheel import (
    Arrays,
    Float,
    Motion,
    Wheel,
    WheelForces,
    broadcast,
    contact_angle,
    depth_below,
    integrated,
    sin_cos,
)
from vertiwm_jax.terrain.soil import Soil

_SHORTEST = 0.02  # m, of a contact whose length enters Bekker's equation


@struct.dataclass
class ScmParams:
    """Coefficients `[...]` beside those of the soil.

    damping: Pa s/m by which a rim that moves downwards raises the pressure.
    fresh_speed: m/s of travel at which the moment of that pressure about the axle reaches 71 %
        of what untouched soil ahead of the hub gives: a wheel that stands, spinning or not, lies
        in its own hole, which presses on both sides alike.
    creep_speed: m/s of slip at which shear reaches 71 % of its strength.
    nodes: of Gauss-Legendre's rule in each of the two pieces of the contact.
    """

    damping: Float = 3e4
    fresh_speed: Float = 1.0
    creep_speed: Float = 0.1
    nodes: int = struct.field(pytree_node=False, default=6)

    def forces(
        self, wheel: Wheel, soil: Soil, sinkage: Float, motion: Motion, rut: Float = 0.0
    ) -> WheelForces:
        """As `SoilContact.forces`.

        The contact has two pieces: where the rim pushes the soil ahead, and where it drags it
        back. Six nodes in each are within 0.4 % of the load (99 % of random wheels), four within
        1 %.
        """
        shape, given = broadcast((self, wheel, soil, sinkage, motion, rut))
        contact, wheel, soil, sinkage, (velocity_x, velocity_y, omega), rut = given
        # Seen along the travel, so that the soil is always entered ahead.
        both = velocity_x + wheel.radius * omega
        ahead = jnp.where(both >= 0, 1.0, -1.0)
        hub, rim = ahead * velocity_x, ahead * wheel.radius * omega
        creep = contact.creep_speed
        fresh = hub * jax.lax.rsqrt(hub**2 + contact.fresh_speed**2)

        depth, touching = depth_below(rut, sinkage, wheel)
        # Ground is pressed from above: by the lower half of a wheel, also of one sunk beyond its
        # hub.
        entry = jnp.minimum(contact_angle(depth), jnp.pi / 2)
        sin_entry, cos_entry = jnp.sin(entry), jnp.cos(entry)
        length = jnp.maximum(wheel.radius * sin_entry, _SHORTEST)
        keq = soil.kc * (1 / wheel.width + 1 / length) + soil.kphi

        # The rim drags the soil back as far as rim cos(angle) > hub.
        overtaken = jnp.clip(hub / jnp.where(rim > creep / 100, rim, creep / 100), 0.0, 1.0)
        turn = jnp.minimum(contact_angle(1 - overtaken), entry)

        def slipped(angle: jax.Array, sin: jax.Array, cos: jax.Array) -> jax.Array:
            """Slip summed over the ground from the hub to `angle`, times hub speed over radius."""
            return rim * (angle + sin * cos) / 2 - hub * sin

        at_entry = slipped(entry, sin_entry, cos_entry)
        at_turn = slipped(turn, jnp.sin(turn), jnp.cos(turn))
        speed = jnp.sqrt(hub**2 + creep**2)

        def stresses(
            pushed: jax.Array, point: jax.Array, weight: jax.Array
        ) -> tuple[jax.Array, Arrays]:
            """Along, across, upwards and about the axle, at a point of the rim."""
            start, stop = jnp.where(pushed, turn, 0.0), jnp.where(pushed, entry, turn)
            angle = start + point * (stop - start)
            sin, cos = sin_cos(angle)
            z = jnp.maximum(wheel.radius * (cos - 1 + depth) + rut, 1e-9)
            sigma = (
                keq * jnp.exp(soil.n * jnp.log(z)) + contact.damping * jnp.maximum(rim, 0.0) * sin
            )
            # The path of the soil since it met the wheel, there and back. What lies in a rut has
            # been sheared before, about as far as it was pressed.
            here = slipped(angle, sin, cos)
            path = jnp.where(pushed, here - at_entry, 2 * at_turn - at_entry - here)
            side = velocity_y * (sin_entry - sin)
            path = jnp.sqrt(path**2 + side**2 + (1e-3 * creep) ** 2) * wheel.radius / speed + rut
            along, across = rim * cos - hub, -velocity_y
            strength = soil.cohesion + sigma * jnp.tan(soil.friction_angle)
            tau = strength * (1 - jnp.exp(-path / soil.shear_modulus))
            tau = tau * jax.lax.rsqrt(along**2 + across**2 + creep**2)
            moment = tau * along * cos + fresh * sigma * sin
            weight = weight * (stop - start) * cos
            return weight, (tau * along, tau * across, sigma, moment)

        total = integrated(stresses, _quadrature(self.nodes), shape)
        longitudinal, lateral, normal, torque = (jnp.where(touching, t, 0.0) for t in total)
        area = wheel.radius * wheel.width
        return WheelForces(
            longitudinal=ahead * area * longitudinal,
            lateral=area * lateral,
            normal=area * normal,
            torque=ahead * area * wheel.radius * torque,
        )


def _quadrature(nodes: int) -> Arrays:
    """Whether pushed ahead, Gauss-Legendre point and weight on [0, 1] of every node `[2 nodes]`."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    points, weights = (np.tile(y, 2).astype(np.float32) for y in ((x + 1) / 2, w / 2))
    return jnp.arange(2 * nodes) >= nodes, jnp.asarray(points), jnp.asarray(weights)
