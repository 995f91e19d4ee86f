"""Predicts soil parameters from the semantic latent (Sec. IV-B)."""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp

from vertiwm_jax.terrain.soil import Soil

# Wong, Theory of Ground Vehicles, 4th ed. (2008), table 2.3, from snow and wet loam to sand and
# stiff clay, widened on both sides; K after Wong's ranges by class of soil (clay .006 to snow
# .05 m). A modulus or cohesion of zero is one too small to matter: on a logarithmic scale, and
# beside the lowest kphi under a wheel of a quarter of a metre, 10 N/m^(n+1) is 0.2 %.
BOUNDS: dict[str, tuple[float, float]] = {
    "kc": (1e1, 5e5),
    "kphi": (2e4, 2e7),
    "n": (0.05, 2.0),
    "cohesion": (1e1, 2e5),
    "friction_angle": (math.radians(5), math.radians(50)),
    "shear_modulus": (2e-3, 1e-1),
}
"""Lowest and highest value of each predicted field of `Soil`, in its units."""

_LOGARITHMIC = ("kc", "kphi", "cohesion", "shear_modulus")


class SoilPredictor(nn.Module):
    """The six parameters of Bekker, Mohr-Coulomb and Janosi-Hanamoto, within `BOUNDS`.

    28,262 parameters. The convolutions have stride 2. That keeps the paper's number of parameters
    at a tenth of the cost (1.3 MFLOP), and the mean over space that follows would drop details
    anyway.
    """

    @nn.compact
    def __call__(self, latent: jax.Array, unit_weight: jax.Array) -> Soil:
        """`[..., 16, 16, 18]` semantic latent to a soil `[...]`.

        unit_weight: rho g, N/m3, `[...]` or broadcast; passed through, for it is not among the
            six and enters the bulldozing force alone.
        """
        x = nn.silu(nn.Conv(32, (3, 3), strides=2)(latent))
        x = nn.silu(nn.Conv(64, (3, 3), strides=2)(x))
        x = jnp.mean(x, axis=(-3, -2))
        x = nn.silu(nn.Dense(64)(x))
        return of_shares(nn.sigmoid(nn.Dense(len(BOUNDS))(x)), unit_weight)


def of_shares(shares: jax.Array, unit_weight: jax.Array) -> Soil:
    """`[..., 6]` where in `BOUNDS` each parameter lies to soils `[...]`: the inverse of `shares`.

    unit_weight: rho g, N/m3, `[...]` or broadcast.
    """
    fields = {
        name: _between(shares[..., i], *bounds, name in _LOGARITHMIC)
        for i, (name, bounds) in enumerate(BOUNDS.items())
    }
    return Soil(**fields, unit_weight=jnp.broadcast_to(unit_weight, shares.shape[:-1]))


def shares(soil: Soil) -> jax.Array:
    """`[...]` soils to `[..., 6]` where in `BOUNDS` each parameter lies, from 0 to 1."""
    columns = []
    for name, (low, high) in BOUNDS.items():
        value = jnp.clip(getattr(soil, name), low, high)
        if name in _LOGARITHMIC:
            columns.append(jnp.log(value / low) / math.log(high / low))
        else:
            columns.append((value - low) / (high - low))
    return jnp.stack(columns, axis=-1)


def _between(share: jax.Array, low: float, high: float, logarithmic: bool) -> jax.Array:
    """Shares `[...]` in [0, 1] to values from low to high, even in the value or its logarithm."""
    if logarithmic:
        return low * jnp.exp(share * math.log(high / low))
    return low + (high - low) * share
