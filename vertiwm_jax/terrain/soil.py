"""Soil parameters of the Bekker, Mohr-Coulomb and Janosi-Hanamoto equations."""

import jax
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
