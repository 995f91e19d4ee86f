"""Terrain autoencoders: patches of the ground to 18 x 16 x 16 latents and back (Sec. IV-B).

Channels come last everywhere. A latent cell covers 8 x 8 pixels, 0.8 m of ground.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.terrain.patches import CELL_PIXELS

LATENT_CHANNELS = 18
_COARSE = 23


class TerrainEncoder(nn.Module):
    """A small U-Net from a patch to its latent; 21,586 parameters for one and three channels.

    A linear map takes every cell of 8 x 8 pixels straight to its 18 numbers, which is what keeps
    centimetres of relief; a branch at half the resolution adds what the neighbourhood says.
    Nothing runs at the resolution of the pixels: 1.6 MFLOP for one channel, 2.8 for three.

    channels: 1 for elevation, 3 for semantic colours.
    """

    channels: int

    def setup(self) -> None:
        shape = self.channels, CELL_PIXELS**2, LATENT_CHANNELS
        self.cell_kernel = self.param("cell_kernel", _analysis, shape)
        self.cell_bias = self.param("cell_bias", nn.initializers.zeros, (LATENT_CHANNELS,))
        self.Conv_0 = _Halving(24)
        self.Conv_1 = nn.Conv(_COARSE, (3, 3))
        self.expand = _Linear(_COARSE, 4 * LATENT_CHANNELS)

    def __call__(self, patch: jax.Array) -> jax.Array:
        """`[..., 128, 128, channels]` in about [-1, 1] to `[..., 16, 16, 18]`."""
        assert patch.shape[-1] == self.channels, patch.shape
        projected = _cells(patch) @ self.cell_kernel.reshape(-1, LATENT_CHANNELS)
        fours = _space_to_depth(projected, 2)
        return in_rows(self.of_fours(fours.reshape(*fours.shape[:-1], 4, LATENT_CHANNELS)).latent)

    def of_fours(self, projected: jax.Array) -> "Fours":
        """The same of what `cell_kernel` makes of each cell, four by four: `[..., 8, 8, 4, 18]`."""
        fours = projected.reshape(*projected.shape[:-2], -1) + jnp.tile(self.cell_bias, 4)
        coarse = nn.silu(self.Conv_1(nn.silu(self.Conv_0(fours))))
        return Fours(fours, coarse, self.expand.kernel, self.expand.bias)


@struct.dataclass
class Fours:
    """A latent of four cells by four, whose sum need not be made to know what is linear in it.

    fine: `[..., 8, 8, 4 * 18]` one addend; the other is `coarse` `[..., 8, 8, 23]` times `kernel`
        `[23, 4 * 18]`, and `bias` `[4 * 18]`.
    """

    fine: jax.Array
    coarse: jax.Array
    kernel: jax.Array
    bias: jax.Array

    @property
    def latent(self) -> jax.Array:
        """`[..., 8, 8, 4, 18]`."""
        return _of_each(self.fine + (self.coarse @ self.kernel + self.bias))

    @property
    def mean(self) -> jax.Array:
        """`[..., 18]` over all cells."""
        fine, coarse = (jnp.mean(x, axis=(-3, -2)) for x in (self.fine, self.coarse))
        return jnp.mean(_of_each(fine + coarse @ self.kernel + self.bias), axis=-2)

    def __matmul__(self, matrix: jax.Array) -> jax.Array:
        """The latent times `[18, C]`, `[..., 8, 8, 4, C]`."""
        kernel, bias = _of_each(self.kernel) @ matrix, _of_each(self.bias) @ matrix
        added = self.coarse @ kernel.reshape(len(kernel), -1)
        of_fine = _of_each(self.fine) @ matrix
        return of_fine + added.reshape(of_fine.shape) + bias


def _of_each(fours: jax.Array) -> jax.Array:
    """`[..., 4 * 18]` to `[..., 4, 18]`."""
    return fours.reshape(*fours.shape[:-1], 4, LATENT_CHANNELS)


class _Linear(nn.Module):
    """The weights of a `nn.Dense`, which begin as zeros, for who multiplies otherwise."""

    inputs: int
    outputs: int

    def setup(self) -> None:
        zeros = nn.initializers.zeros
        self.kernel = self.param("kernel", zeros, (self.inputs, self.outputs))
        self.bias = self.param("bias", zeros, (self.outputs,))


class _Halving(nn.Module):
    """A convolution of 2 x 2 cells with strides of 2, as a matmul of what lies side by side."""

    features: int

    @nn.compact
    def __call__(self, fours: jax.Array) -> jax.Array:
        """`[..., h, w, 4 C]`, row by row of the 2 x 2 cells, to `[..., h, w, features]`."""
        shape = 2, 2, fours.shape[-1] // 4, self.features
        kernel = self.param("kernel", nn.linear.default_kernel_init, shape)
        bias = self.param("bias", nn.initializers.zeros, shape[-1:])
        return fours @ kernel.reshape(-1, self.features) + bias


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

    def encode(self, patch: jax.Array) -> jax.Array:
        """`[..., 128, 128, channels]` to `[..., 16, 16, 18]`."""
        return self.encoder(patch)


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
    centre = np.arange(CELL_PIXELS) + 0.5
    wave = np.cos(np.pi / CELL_PIXELS * centre[:, None] * frequency)
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


def in_rows(fours: jax.Array) -> jax.Array:
    """`[..., h, w, 4, c]`, row by row of each 2 x 2 cells, to `[..., 2 h, 2 w, c]`."""
    return _depth_to_space(fours.reshape(*fours.shape[:-2], -1), 2)


def _depth_to_space(x: jax.Array, block: int) -> jax.Array:
    """`[..., h, w, block * block * c]` to `[..., h * block, w * block, c]`, a block from each."""
    *batch, h, w, c = x.shape
    x = x.reshape(*batch, h, w, block, block, c // block**2)
    return jnp.swapaxes(x, -4, -3).reshape(*batch, h * block, w * block, -1)


def _space_to_depth(x: jax.Array, block: int) -> jax.Array:
    """`[..., h, w, c]` to `[..., h / block, w / block, c block**2]`, the inverse."""
    *batch, h, w, c = x.shape
    x = x.reshape(*batch, h // block, block, w // block, block, c)
    return jnp.swapaxes(x, -4, -3).reshape(*batch, h // block, w // block, -1)
