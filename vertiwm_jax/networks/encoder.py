"""Terrain autoencoders: patches of the ground to 18 x 16 x 16 latents and back (Sec. IV-B).

Channels come last everywhere. A latent cell covers 8 x 8 pixels, 0.8 m of ground.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.terrain.patches import CELL_PIXELS

LATENT_CHANNELS = 18
_COARSE = 23


class TerrainEncoder(nn.Module):
    """A small U-Net from a patch to its latent; 21,586 parameters for one and three channels.

    A linear map takes every cell of 8 x 8 pixels straight to its 18 numbers, which is what keeps
    centimeters of relief; a branch at half the resolution adds what the neighborhood says.
    Nothing runs at the resolution of the pixels: 1.6 MFLOP for one channel, 2.8 for three.

    channels: 1 for elevation, 3 for semantic colors.
    """

    channels: int

    def setup(self) -> None:
        shape = self.channels, CELL_PIXELS**2, LATENT_CHANNELS
        self.cell_kernel = self.param("cell_kernel", _analysis, shape)
        self.cell_bias = self.param("cell_bias", nn.initializers.zeros, (LATENT_CHANNELS,))
        self.Conv_0 = nn.Conv(24, (2, 2), strides=2, padding="VALID")
        self.Conv_1 = nn.Conv(_COARSE, (3, 3))
        self.expand = nn.Dense(4 * LATENT_CHANNELS, kernel_init=nn.initializers.zeros)

    def __call__(self, patch: jax.Array) -> jax.Array:
        """`[..., 128, 128, channels]` in about [-1, 1] to `[..., 16, 16, 18]`."""
        assert patch.shape[-1] == self.channels, patch.shape
        fine = _cells(patch) @ self.cell_kernel.reshape(-1, LATENT_CHANNELS) + self.cell_bias
        coarse = nn.silu(self.Conv_1(nn.silu(self.Conv_0(fine))))
        return fine + _depth_to_space(self.expand(coarse), 2)


class TerrainDecoder(nn.Module):
    """A latent back to the patch that it came from; 32,800 parameters for one and three channels.

    Unlike the decoder of a U-Net it sees the latent alone: with a skip connection past the
    latent, a small reconstruction error would not mean that the latent holds the ground, and the
    latent is all that a specialist is given.
    """

    channels: int

    @nn.compact
    def __call__(self, latent: jax.Array) -> jax.Array:
        """`[..., 16, 16, 18]` to `[..., 128, 128, channels]`, unbounded."""
        pixels = CELL_PIXELS**2 * self.channels
        linear = nn.Dense(pixels, use_bias=False, kernel_init=_synthesis, name="linear")
        correct = nn.Dense(pixels, kernel_init=nn.initializers.zeros, name="correct")
        features = nn.silu(nn.Conv(48, (3, 3))(latent))
        return _depth_to_space(linear(latent) + correct(features), CELL_PIXELS)


class TerrainAutoencoder(nn.Module):
    """Encoder and decoder, trained together on the squared error of the reconstruction."""

    channels: int

    def setup(self) -> None:
        self.encoder = TerrainEncoder(self.channels)
        self.decoder = TerrainDecoder(self.channels)

    def __call__(self, patch: jax.Array) -> jax.Array:
        """`[..., 128, 128, channels]` to its reconstruction, of the same shape."""
        return self.decoder(self.encoder(patch))


def _analysis(key: jax.Array, shape: tuple[int, ...], dtype: jnp.dtype = jnp.float32) -> jax.Array:
    """The encoder's first map `[C, 64, 18]`: the smoothest cosine modes of a cell, 18 / C each.

    Ground is so smooth that these hold nearly all of it. From random weights the modes after the
    mean, hundredths of its variance, take most of the training to appear.
    """
    modes, gain = _cosine_modes(LATENT_CHANNELS // shape[0])
    # Channel c fills latents c, c + C, c + 2 C, ...
    kernel = np.einsum("pm,cd->cpmd", modes * gain, np.eye(shape[0]))
    return jnp.asarray(kernel.reshape(shape), dtype)


def _synthesis(key: jax.Array, shape: tuple[int, ...], dtype: jnp.dtype = jnp.float32) -> jax.Array:
    """The decoder's first linear map `[18, 64 C]`: the pseudo-inverse of `_analysis`."""
    channels = shape[1] // CELL_PIXELS**2
    modes, gain = _cosine_modes(LATENT_CHANNELS // channels)
    kernel = np.einsum("pm,cd->mdpc", modes / gain, np.eye(channels))
    return jnp.asarray(kernel.reshape(shape), dtype)


def _cosine_modes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """The `count` smoothest orthonormal modes `[64, count]` of a cell, and gains `[count]`.

    The gain of the mean makes it the mean of the pixels; finer modes, which are smaller in the
    ground, are scaled up.
    """
    frequency = np.arange(CELL_PIXELS)
    center = np.arange(CELL_PIXELS) + 0.5
    wave = np.cos(np.pi / CELL_PIXELS * center[:, None] * frequency)
    wave /= np.linalg.norm(wave, axis=0)
    i, j = (index.ravel() for index in np.meshgrid(frequency, frequency, indexing="ij"))
    smoothest = np.argsort(i**2 + j**2, kind="stable")[:count]
    modes = np.einsum("pi,qj->pqij", wave, wave).reshape(CELL_PIXELS**2, -1)[:, smoothest]
    return modes, (1.0 + i + j)[smoothest] / CELL_PIXELS


def _cells(patch: jax.Array) -> jax.Array:
    """`[..., 128, 128, C]` to the pixels of each cell, channel by channel, `[..., 16, 16, 64 C]`.

    In the order in which pixels are computed, so that they stay where they are.
    """
    *batch, h, w, channels = patch.shape
    h, w = h // CELL_PIXELS, w // CELL_PIXELS
    cells = patch.reshape(*batch, h, CELL_PIXELS, w, CELL_PIXELS, channels)
    first = len(batch)
    order = *range(first), *(first + i for i in (0, 2, 4, 1, 3))
    return cells.transpose(order).reshape(*batch, h, w, -1)


def _depth_to_space(x: jax.Array, block: int) -> jax.Array:
    """`[..., h, w, block * block * c]` to `[..., h * block, w * block, c]`, a block from each."""
    *batch, h, w, c = x.shape
    x = x.reshape(*batch, h, w, block, block, c // block**2)
    return jnp.swapaxes(x, -4, -3).reshape(*batch, h * block, w * block, -1)
