"""Where the soil carries the load: equilibrium sinkage."""

import jax
import jax.numpy as jnp

from vertiwm_jax.mechanics.wheel import MAX_SINKAGE, Float, Motion, SoilContact, Wheel
from vertiwm_jax.terrain.soil import Soil

_BISECTIONS = 26  # of 1.5 radii: past the last bit of float32


def equilibrium_sinkage(
    wheel: Wheel, soil: Soil, contact: SoilContact, load: Float, motion: Motion, rut: Float = 0.0
) -> jax.Array:
    """Sinkage in m at which the normal force equals `load` in N, all `[...]`.

    The floor of the rut (zero on undisturbed soil) without load; `MAX_SINKAGE` radii below the
    bottom of the rut where the soil cannot carry it. Differentiable in both modes by the
    implicit-function theorem; the gradient is zero without load.
    """

    def unbalanced(sinkage: jax.Array) -> jax.Array:
        return contact.forces(wheel, soil, sinkage, motion, rut).normal - load

    def bisect(residual, low: jax.Array) -> jax.Array:
        def halve(_, bracket: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            low, high = bracket
            middle = (low + high) / 2
            carried = residual(middle) >= 0
            return jnp.where(carried, low, middle), jnp.where(carried, middle, high)

        high = low + rut + MAX_SINKAGE * wheel.radius
        low, high = jax.lax.fori_loop(0, _BISECTIONS, halve, (low, high))
        return high

    def divide(linear, right: jax.Array) -> jax.Array:
        slope = linear(jnp.ones_like(right))
        stiff = slope > 0
        return jnp.where(stiff, right / jnp.where(stiff, slope, 1.0), 0.0)

    start = jnp.zeros_like(unbalanced(jnp.zeros(())))
    return jax.lax.custom_root(unbalanced, start, bisect, divide)
