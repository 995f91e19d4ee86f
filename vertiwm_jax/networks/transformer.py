"""A causal Transformer over a sliding window of tokens, one token a step.

Positions are rotary (Su et al., 2021, "RoFormer"), so that attention knows only how far apart two
tokens are, wherever the cache keeps them.
"""

import math
from functools import partial
from typing import Any, Self

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

_PERIODS_A_WINDOW = 16
_MASKED = -1e30  # finite: the softmax of a masked score is 0 and its gradient is no NaN


def _as_kernel(*operands: Any, **_: Any) -> list[Any]:
    inputs, kernel, bias = operands
    return [inputs.astype(kernel.dtype), kernel, bias]


Dense = partial(
    nn.Dense,
    promote_dtype=_as_kernel,
    dot_general=partial(jax.lax.dot_general, preferred_element_type=jnp.float32),
)
"""`nn.Dense` whose operands are rounded as its kernel is, to bfloat16 perhaps; sums are float32."""


@struct.dataclass
class KeyValueCache:
    """The last W tokens as every layer sees them; all zeros is the empty cache.

    keys, values: for each layer `[..., heads, W, width / heads]`, ring buffers over W; the token
        of position p lies in slot p mod W, its key rotated by p.
    age: `[...]` int32 tokens since the cache was empty, folded back by a rotary period once the
        window is full, so that it stays bounded however long an episode lasts.
    """

    keys: tuple[jax.Array, ...]
    values: tuple[jax.Array, ...]
    age: jax.Array

    @classmethod
    def empty(cls, layers: int, shape: tuple[int, ...]) -> Self:
        """The cache before the first token, with keys and values of `shape` in each layer."""
        zeros = tuple(jnp.zeros(shape) for _ in range(layers))
        return cls(zeros, zeros, jnp.zeros(shape[:-3], jnp.int32))


class Transformer(nn.Module):
    """Pre-norm causal Transformer whose tokens attend to the `window` latest, themselves included.

    layers: number of blocks of attention and MLP.
    width: D, the width of a token, a multiple of twice `heads`.
    heads: number of attention heads.
    hidden: width of the MLPs.
    window: W, the number of tokens that a token can see.
    """

    layers: int
    width: int
    heads: int
    hidden: int
    window: int = 16

    def setup(self) -> None:
        if self.width % (2 * self.heads):
            raise ValueError(
                f"Transformer: width: expected a multiple of twice the {self.heads} heads, "
                f"found {self.width}"
            )
        self.blocks = [
            _Block(self.width, self.heads, self.hidden, 1 / (2 * self.layers))
            for _ in range(self.layers)
        ]
        self.norm = nn.RMSNorm()

    def __call__(self, token: jax.Array, cache: KeyValueCache) -> tuple[jax.Array, KeyValueCache]:
        """`[..., D]` one token to `[..., D]` and the cache that holds it."""
        turn = self._turn(cache.age[..., None])
        slot = cache.age % self.window
        visible = jnp.arange(self.window) <= cache.age[..., None]
        keys, values = [], []
        for block, key, value in zip(self.blocks, cache.keys, cache.values, strict=True):
            token, key, value = block(token, key, value, turn, slot, visible)
            keys.append(key)
            values.append(value)
        age = cache.age + 1
        age = jnp.where(age < self._period + self.window, age, age - self._period)
        return self.norm(token), KeyValueCache(tuple(keys), tuple(values), age)

    @property
    def _period(self) -> int:
        """Positions after which every rotation repeats."""
        return _PERIODS_A_WINDOW * self.window

    def _turn(self, position: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Positions `[...]` to the cosine and sine `[..., width / heads / 2]` of their rotations.

        Frequencies fall geometrically from 1 rad a token and are whole cycles a period: positions
        a period apart are one. From a table, or XLA would compute them for every head and layer.
        """
        fastest = self._period / (2 * math.pi)
        cycles = np.rint(np.geomspace(fastest, 1.0, self.width // self.heads // 2))
        angle = 2 * math.pi / self._period * np.arange(self._period)[:, None] * cycles
        cos, sin = jnp.asarray(np.cos(angle), jnp.float32), jnp.asarray(np.sin(angle), jnp.float32)
        return cos[position % self._period], sin[position % self._period]


class _Block(nn.Module):
    """Attention and a SiLU MLP, each normalized before and added to what it read.

    output_variance: of the weights that write to the residual, relative to the usual; less for
        more layers, so that the sum does not grow with depth (Radford et al., 2019, GPT-2).
    """

    width: int
    heads: int
    hidden: int
    output_variance: float

    def setup(self) -> None:
        output = nn.initializers.variance_scaling(
            self.output_variance, "fan_in", "truncated_normal"
        )
        self.attention_norm = nn.RMSNorm()
        self.query_key_value = Dense(3 * self.width, use_bias=False)
        self.attention_output = Dense(self.width, use_bias=False, kernel_init=output)
        self.mlp_norm = nn.RMSNorm()
        self.mlp_hidden = Dense(self.hidden)
        self.mlp_output = Dense(self.width, kernel_init=output)

    def __call__(
        self,
        token: jax.Array,
        keys: jax.Array,
        values: jax.Array,
        turn: tuple[jax.Array, jax.Array],
        slot: jax.Array,
        visible: jax.Array,
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """`[..., D]` and one layer's cache to the same; slot `[...]`, visible `[..., W]`."""
        projected = self.query_key_value(self.attention_norm(token))
        split = projected.reshape(*token.shape[:-1], 3, self.heads, -1)
        query, key, value = jnp.moveaxis(split, -3, 0)  # each [..., heads, d]
        query, key = _rotate(query, turn), _rotate(key, turn)
        keys, values = _write(keys, key, slot), _write(values, value, slot)
        scores = jnp.einsum("...hd,...hkd->...hk", query, keys) / math.sqrt(keys.shape[-1])
        weights = jax.nn.softmax(jnp.where(visible[..., None, :], scores, _MASKED), axis=-1)
        attended = jnp.einsum("...hk,...hkd->...hd", weights, values)
        token = token + self.attention_output(attended.reshape(token.shape))
        token = token + self.mlp_output(nn.silu(self.mlp_hidden(self.mlp_norm(token))))
        return token, keys, values


def _rotate(vectors: jax.Array, turn: tuple[jax.Array, jax.Array]) -> jax.Array:
    """Turns each pair (i, d / 2 + i) of `[..., d]` by an angle given as cosine and sine."""
    cos, sin = turn
    first, second = jnp.split(vectors, 2, axis=-1)
    return jnp.concatenate([first * cos - second * sin, first * sin + second * cos], axis=-1)


def _write(ring: jax.Array, new: jax.Array, slot: jax.Array) -> jax.Array:
    """`[..., heads, W, d]` with `[..., heads, d]` in slot `[...]`.

    A write in place, also when every vehicle of a batch has a slot of its own; masks and rolls
    of the whole ring, and rings that are not contiguous by head, take longer inside a scan.
    """

    def write(ring: jax.Array, new: jax.Array, slot: jax.Array) -> jax.Array:
        return jax.lax.dynamic_update_slice_in_dim(ring, new[:, None], slot, axis=1)

    for _ in range(slot.ndim):
        write = jax.vmap(write)
    return write(ring, new, slot)
