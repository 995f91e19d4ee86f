"""The network of both specialists: tokens of past steps through a cached causal Transformer."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import flax.linen as nn
import jax
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

    def empty_cache(self, batch: tuple[int, ...] = ()) -> KeyValueCache:
        """The cache before the first token, with leading axes `batch`."""
        shape = (*batch, self.heads, WINDOW, self.width // self.heads)
        return KeyValueCache.empty(self.layers, shape)


BASE = NetworkSize(layers=3, width=128, heads=4, hidden=256, channels=8)
"""The shipped default."""
PAPER = NetworkSize(layers=3, width=320, heads=10, hidden=1280, channels=16)
"""Half of the paper's 9,972,634 parameters of dynamics."""
PAPER_WHOLE = replace(PAPER, layers=7)
"""All of them in one network, as in the paper's Transformers that learn from everything."""


class SpecialistNetwork(nn.Module):
    """What a step looks like, and what is known of the ground, to twelve numbers a step."""

    size: NetworkSize

    def setup(self) -> None:
        size = self.size
        self.embed = nn.Dense(size.width)
        self.embed_ground = Dense(size.width, use_bias=False)
        self.transformer = Transformer(size.layers, size.width, size.heads, size.hidden, WINDOW)
        # Untrained, it changes nothing: the mean transition stays, or physics.
        self.head = nn.Dense(12, kernel_init=nn.initializers.zeros)

    def __call__(
        self, inputs: jax.Array, ground: jax.Array | None, cache: KeyValueCache
    ) -> tuple[jax.Array, KeyValueCache]:
        """`[..., F]` of a step and `[..., G]` of the ground to `[..., 12]`, by the last steps."""
        token = self.embed(inputs)
        if ground is not None:
            token = token + self.embed_ground(ground)
        token, cache = self.transformer(token, cache)
        return self.head(token), cache


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
