"""Soil parameters of the Bekker, Mohr-Coulomb and Janosi-Hanamoto equations."""

import math
from collections.abc import Sequence
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct


@struct.dataclass
class Soil:
    """One soil, or many with any leading axes `[...]`; SI units.

    kc: cohesive modulus of deformation, N/m^(n+1).
    kphi: frictional modulus of deformation, N/m^(n+2).
    n: exponent of sinkage.
    cohesion: Pa.
    friction_angle: angle of internal friction, rad.
    shear_modulus: shear deformation modulus K, m.
    unit_weight: rho g, N/m3.
    """

    kc: jax.Array
    kphi: jax.Array
    n: jax.Array
    cohesion: jax.Array
    friction_angle: jax.Array
    shear_modulus: jax.Array
    unit_weight: jax.Array


def _soil(
    kc: float, kphi: float, n: float, cohesion: float, phi: float, k: float, weight: float
) -> Soil:
    """A preset from kN, kPa and degrees, of NumPy numbers, since importing must not start JAX."""
    si = (1e3 * kc, 1e3 * kphi, n, 1e3 * cohesion, math.radians(phi), k, 1e3 * weight)
    return Soil(*(cast(jax.Array, np.asarray(value, np.float32)) for value in si))


# Columns: kc kN/m^(n+1), kphi kN/m^(n+2), n, cohesion kPa, friction angle deg, K m, rho g kN/m3.
# Only Bekker's and Mohr's parameters are tabulated by soil. K is the middle of the range that
# Wong gives for the class of soil (sand and loam .01-.025, clay .006-.01, snow .03-.05) and
# rho g, which enters the bulldozing force alone, is a usual value of the class.
PRESETS: dict[str, Soil] = {
    # Verti-Bench's deformable classes (its SCM parameters; rho g as above).
    "mud": _soil(0, 2000, 1.1, 0, 30, 0.010, 17),
    "sand": _soil(102, 5301, 0.793, 1.3, 31.1, 0.012, 15.5),
    "snow": _soil(0, 200, 1.1, 0, 30, 0.010, 3),
    # Wong, Theory of Ground Vehicles, 4th ed. (2008), table 2.3; per cent is moisture.
    "dry_sand": _soil(0.99, 1528.43, 1.1, 1.04, 28, 0.0175, 15.5),
    "sandy_loam_15": _soil(5.27, 1515.04, 0.7, 1.72, 29, 0.0175, 15),
    "sandy_loam_22": _soil(2.56, 43.12, 0.2, 1.38, 38, 0.0175, 16),
    "sandy_loam_michigan_11": _soil(52.53, 1127.97, 0.9, 4.83, 20, 0.0175, 15),
    "sandy_loam_michigan_23": _soil(11.42, 808.96, 0.4, 9.65, 35, 0.0175, 16),
    "clayey_soil_38": _soil(13.19, 692.15, 0.5, 4.14, 13, 0.008, 17),
    "heavy_clay_25": _soil(12.70, 1555.95, 0.13, 68.95, 34, 0.008, 18),
    "lean_clay_22": _soil(16.43, 1724.69, 0.2, 68.95, 20, 0.008, 18),
    "lete_sand": _soil(102, 5301, 0.79, 1.3, 31.1, 0.0175, 15.5),
    "upland_sandy_loam_51": _soil(74.6, 2080, 1.10, 3.3, 33.7, 0.0175, 16),
    "grenville_loam_24": _soil(0.06, 5880, 1.01, 3.1, 29.8, 0.0175, 15),
    "snow_us": _soil(4.37, 196.72, 1.6, 1.03, 19.7, 0.04, 3),
    "snow_harrison": _soil(2.49, 245.90, 1.6, 0.62, 23.2, 0.04, 3),
    "snow_sweden": _soil(10.55, 66.08, 1.44, 6, 20.7, 0.04, 3),
    # Lunar regolith: Wong (2008) table 2.3 and Apollo Lunar Sourcebook; 1.55 t/m3 at 1.62 m/s2.
    "lunar": _soil(1.4, 820, 1.0, 0.17, 35, 0.018, 2.5),
    # Fitted to the trials of Pavlov and Johnson (2024) by `benchmarks.measured_wheels`, each
    # together with the contact of its name in `mechanics.bekker_wong`; friction and cohesion are
    # those between wheel and sand. Moduli are of wheels 50 mm wide, rho g as measured.
    "sand_smooth_wheel": _soil(0, 14490, 1.487, 0.973, 14.0, 0.00503, 13.03),
    "sand_lugged_wheel": _soil(0, 16600, 1.557, 0.354, 23.7, 0.00959, 13.03),
}


def stack(soils: Sequence[Soil]) -> Soil:
    """Stacks S soils with leaves `[...]` to one with leaves `[S, ...]`, float32."""
    if not soils:
        raise ValueError("expected at least one soil")
    return jax.tree.map(
        lambda *leaves: jnp.stack([jnp.asarray(x, jnp.float32) for x in leaves]), *soils
    )


# Wong, Theory of Ground Vehicles, 4th ed. (2008), table 2.3, from snow and wet loam to sand and
# stiff clay, widened on both sides; K after Wong's ranges by class of soil (clay .006 to snow
# .05 m). A modulus or cohesion of zero is one too small to matter: on a logarithmic scale, and
# beside the lowest kphi under a wheel of a quarter of a meter, 10 N/m^(n+1) is 0.2 %.
BOUNDS: dict[str, tuple[float, float]] = {
    "kc": (1e1, 5e5),
    "kphi": (2e4, 2e7),
    "n": (0.05, 2.0),
    "cohesion": (1e1, 2e5),
    "friction_angle": (math.radians(5), math.radians(50)),
    "shear_modulus": (2e-3, 1e-1),
}
"""Lowest and highest value of each field of `Soil` that is estimated, in its units."""

_LOGARITHMIC = ("kc", "kphi", "cohesion", "shear_modulus")


def to_unit(soil: Soil) -> jax.Array:
    """`[...]` soils to `[..., 6]` where in `BOUNDS` each parameter lies, from 0 to 1."""
    columns = []
    for name, (low, high) in BOUNDS.items():
        value = jnp.clip(getattr(soil, name), low, high)
        if name in _LOGARITHMIC:
            columns.append(jnp.log(value / low) / math.log(high / low))
        else:
            columns.append((value - low) / (high - low))
    return jnp.stack(columns, axis=-1)


def from_unit(numbers: jax.Array, unit_weight: jax.Array) -> Soil:
    """`[..., 6]` numbers from 0 to 1, where in `BOUNDS` each parameter lies, to soils `[...]`.

    unit_weight: rho g, N/m3, `[...]` or broadcast.
    """
    fields = {}
    for i, (name, (low, high)) in enumerate(BOUNDS.items()):
        if name in _LOGARITHMIC:
            fields[name] = low * jnp.exp(numbers[..., i] * math.log(high / low))
        else:
            fields[name] = low + (high - low) * numbers[..., i]
    return Soil(**fields, unit_weight=jnp.broadcast_to(unit_weight, numbers.shape[:-1]))


# What each parameter may be, and the mistake that a value outside usually is.
_RANGES: dict[str, tuple[float, float, str]] = {
    "kc": (-1e9, 1e9, "N/m^(n+1); tables give kN/m^(n+1)"),
    "kphi": (1.0, 1e12, "N/m^(n+2); tables give kN/m^(n+2)"),
    "n": (0.05, 3.0, "dimensionless"),
    "cohesion": (0.0, 1e6, "Pa; tables give kPa"),
    "friction_angle": (0.0, 1.2, "rad; tables give degrees"),
    "shear_modulus": (1e-4, 1.0, "m; tables give cm"),
    "unit_weight": (0.0, 1e5, "N/m3, density times gravity"),
}


def out_of_range(soil: Soil) -> str:
    """Names the first parameter of a concrete soil `[...]` that is out of range; "" if none is."""
    for field, (low, high, unit) in _RANGES.items():
        values = np.asarray(getattr(soil, field))
        bad = ~((values >= low) & (values <= high))
        if bad.any():
            return f"{field} of {values[bad].flat[0]:g}, outside {low:g} to {high:g} ({unit})"
    return ""
