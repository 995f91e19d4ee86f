"""Predicts soil parameters from the semantic latent (Sec. IV-B)."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from vertiwm_jax.terrain.soil import BOUNDS, Soil, from_unit


class SoilPredictor(nn.Module):
    """The six parameters of Bekker, Mohr-Coulomb and Janosi-Hanamoto, within `BOUNDS`.

    28,262 parameters. The convolutions have stride 2. That keeps the paper's number of parameters
    at a tenth of the cost (1.3 MFLOP), and the mean over space that follows would drop details
    anyway.
    """

    @nn.compact
    def __call__(self, latent: jax.Array) -> Soil:
        """`[..., 16, 16, 18]` semantic latent to a soil `[...]`.

        Its unit weight, which is not among the six and enters the bulldozing force alone, is 0.
        """
        x = nn.silu(nn.Conv(32, (3, 3), strides=2)(latent))
        x = nn.silu(nn.Conv(64, (3, 3), strides=2)(x))
        x = jnp.mean(x, axis=(-3, -2))
        x = nn.silu(nn.Dense(64)(x))
        return from_unit(nn.sigmoid(nn.Dense(len(BOUNDS))(x)), jnp.float32(0))
