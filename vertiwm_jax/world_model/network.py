"""The network of both specialists: tokens of past steps through a cached causal Transformer."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.tree_util import DictKey

from vertiwm_jax.networks.transformer import Dense, KeyValueCache, Transformer

P = TypeVar("P")

WINDOW = 16
"""Tokens that a specialist remembers, of 0.1 s each."""
ComputeDtype = Literal["float32", "bfloat16"]
"""What the large matrices of specialists, and what they are multiplied by, are rounded to."""


@dataclass(frozen=True)
class NetworkSize:
    """How large a specialist's network is.

    layers, width, heads, hidden: as `networks.Transformer` has them.
    channels: numbers that each cell of the latents is reduced to.
    """

    layers: int
    width: int
    heads: int
    hidden: int
    channels: int


BASE = NetworkSize(layers=3, width=128, heads=4, hidden=256, channels=8)
"""The shipped default."""
PAPER = NetworkSize(layers=3, width=320, heads=10, hidden=1280, channels=16)
"""Half of the paper's 9,972,634 parameters of dynamics."""


@dataclass(frozen=True)
class SpecialistNetwork:
    """What a step looks like, and what is known of the ground, to twelve numbers a step."""

    size: NetworkSize

    def init_params(self, key: jax.Array, inputs: int, ground: int = 0) -> Any:
        """Untrained weights for that many numbers of a step and of the ground; 0 without any."""
        seen = jnp.zeros((1, ground)) if ground else None
        return _Module(self.size).init(key, jnp.zeros((1, inputs)), seen)

    def empty_cache(self, batch: tuple[int, ...] = ()) -> KeyValueCache:
        """The cache before the first token, with leading axes `batch`."""
        return _causal(self.size).empty_cache(batch)

    def step(
        self, weights: Any, inputs: jax.Array, ground: jax.Array | None, cache: KeyValueCache
    ) -> tuple[jax.Array, KeyValueCache]:
        """`[..., F]` of a step and `[..., G]` of the ground to `[..., 12]`, by the last steps."""
        found = _Module(self.size).apply(weights, inputs, ground, cache, method=_Module.step)
        return cast(tuple[jax.Array, KeyValueCache], found)


def cast_weights(params: P, dtype: ComputeDtype) -> P:
    """Parameters whose specialists multiply the large matrices of their networks in `dtype`.

    Encoders, gates, physics, poses and all sums stay float32. In bfloat16 a step is faster where
    the processor multiplies it (AVX512_BF16), and slower elsewhere (docs/performance.md).
    """

    def one(path: Sequence[Any], leaf: jax.Array) -> jax.Array:
        names = [key.key for key in path if isinstance(key, DictKey)]
        large = names[-1:] == ["kernel"] and {"transformer", "embed_ground"} & set(names)
        return leaf.astype(dtype) if large else leaf

    return jax.tree.map_with_path(one, params)


class _Module(nn.Module):
    size: NetworkSize

    def setup(self) -> None:
        self.embed = nn.Dense(self.size.width)
        self.embed_ground = Dense(self.size.width, use_bias=False)
        self.transformer = _causal(self.size)
        # Untrained, it changes nothing: the mean transition stays, or physics.
        self.head = nn.Dense(12, kernel_init=nn.initializers.zeros)

    def __call__(self, inputs: jax.Array, ground: jax.Array | None) -> jax.Array:
        """Whole sequences, `[..., T, F]` and `[..., T, G]` to `[..., T, 12]`."""
        return self.head(self.transformer(self._tokens(inputs, ground)))

    def step(
        self, inputs: jax.Array, ground: jax.Array | None, cache: KeyValueCache
    ) -> tuple[jax.Array, KeyValueCache]:
        """The last of `__call__`, of all steps since the cache was empty."""
        token, cache = self.transformer.step(self._tokens(inputs, ground), cache)
        return self.head(token), cache

    def _tokens(self, inputs: jax.Array, ground: jax.Array | None) -> jax.Array:
        tokens = self.embed(inputs)
        return tokens if ground is None else tokens + self.embed_ground(ground)


def _causal(size: NetworkSize) -> Transformer:
    return Transformer(size.layers, size.width, size.heads, size.hidden, WINDOW)
