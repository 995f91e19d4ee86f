"""The network of both specialists: tokens of past steps through a cached causal Transformer."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from vertiwm_jax.networks.encoder import LATENT_CHANNELS, Fours
from vertiwm_jax.networks.layers import Dense
from vertiwm_jax.networks.transformer import KeyValueCache, Transformer
from vertiwm_jax.world_model.perception import Glance, Perception
from vertiwm_jax.world_model.sizes import TransformerSize

WINDOW = 16
"""Tokens that a specialist remembers, of 0.1 s each."""
Ground = Perception | Glance | jax.Array | None
"""What a specialist is told of the ground: latents, what `Reduction` made of them, an indicator
`[..., 1]`, or nothing."""


class SpecialistNetwork(nn.Module):
    """Features of past steps, and what is known of the ground, to twelve numbers a step."""

    size: TransformerSize

    def setup(self) -> None:
        size = self.size
        self.embed = nn.Dense(size.width)
        self.reduce = Reduction(size.channels)
        self.embed_ground = Dense(size.width, use_bias=False)
        self.transformer = Transformer(size.layers, size.width, size.heads, size.hidden, WINDOW)
        # Untrained, it changes nothing: the mean transition stays, or physics.
        self.head = nn.Dense(12, kernel_init=nn.initializers.zeros)

    def __call__(self, features: jax.Array, ground: Ground) -> jax.Array:
        """`[..., T, F]` and the ground, leaves `[..., T, ...]`, to `[..., T, 12]`."""
        return self.head(self.transformer(self._tokens(features, ground)))

    def step(
        self, features: jax.Array, ground: Ground, cache: KeyValueCache
    ) -> tuple[jax.Array, KeyValueCache]:
        """`[..., F]` and the ground, leaves `[...]`, to `[..., 12]`, the last of `__call__`."""
        token, cache = self.transformer.step(self._tokens(features, ground), cache)
        return self.head(token), cache

    def empty_cache(self, batch: tuple[int, ...] = ()) -> KeyValueCache:
        """As `Transformer.empty_cache`."""
        return self.transformer.empty_cache(batch)

    def _tokens(self, features: jax.Array, ground: Ground) -> jax.Array:
        tokens = self.embed(features)
        if ground is None:
            return tokens
        if isinstance(ground, Perception):
            ground = self.reduce(ground.elevation, ground.semantic)
            ground = ground.reshape(*tokens.shape[:-1], -1)
        if isinstance(ground, Glance):
            ground = ground.reduced
        return tokens + self.embed_ground(ground)


class Reduction(nn.Module):
    """A `nn.Dense` on both latents of every cell, without a copy of them beside each other."""

    channels: int

    @nn.compact
    def __call__(self, elevation: jax.Array | Fours, semantic: jax.Array | Fours) -> jax.Array:
        """Latents `[..., 18]` of each to `[..., channels]`."""
        shape = 2 * LATENT_CHANNELS, self.channels
        kernel = self.param("kernel", nn.linear.default_kernel_init, shape)
        bias = self.param("bias", nn.initializers.zeros, shape[1:])
        of_elevation, of_semantic = jnp.split(kernel, 2)
        return elevation @ of_elevation + semantic @ of_semantic + bias
