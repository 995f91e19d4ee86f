"""The networks of the shipped model as PyTorch modules, built from the weights of flax."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.peers.torch_query import tensor
from vertiwm_jax.networks.specialist import WINDOW, NetworkSize
from vertiwm_jax.terrain.patches import CELL_PIXELS

Weights = Mapping[str, Any]
"""What flax calls the parameters of a module."""
_PERIODS_A_WINDOW = 16
"""As `networks.transformer` has it."""
_NORM_EPSILON = 1e-6
"""Flax's."""


class Encoder(nn.Module):
    """`networks.TerrainEncoder`, channels first."""

    def __init__(self, weights: Weights):
        super().__init__()
        planes, _, latent = weights["cell_kernel"].shape
        cells = np.reshape(weights["cell_kernel"], (planes, CELL_PIXELS, CELL_PIXELS, latent))
        self.cells = _convolution(cells.transpose(1, 2, 0, 3), weights["cell_bias"], CELL_PIXELS)
        self.shrink = _convolution(weights["Conv_0"]["kernel"], weights["Conv_0"]["bias"], 2)
        self.mix = _convolution(weights["Conv_1"]["kernel"], weights["Conv_1"]["bias"], 1, 1)
        # pixel_shuffle has the places of a block innermost, flax's kernel has them outermost.
        places = np.arange(4 * latent).reshape(4, latent).T.ravel()
        kernel, bias = weights["expand"]["kernel"], weights["expand"]["bias"]
        self.expand = _convolution(kernel[None, None, :, places], bias[places])

    def forward(self, patch: Tensor) -> Tensor:
        """`[B, channels, 128, 128]` to `[B, 18, 16, 16]`."""
        latent = self.cells(patch)
        coarse = F.silu(self.mix(F.silu(self.shrink(latent))))
        return latent + F.pixel_shuffle(self.expand(coarse), 2)


class Cache(NamedTuple):
    """Rings of the last 16 tokens, each layer's `[B, heads, W, d]`, written in place; age `[B]`."""

    keys: list[Tensor]
    values: list[Tensor]
    age: Tensor


class Block(nn.Module):
    """A pre-norm block of attention and MLP, for one token at a time."""

    def __init__(self, weights: Weights, heads: int):
        super().__init__()
        self.heads = heads
        self.attention_norm = _norm(weights["attention_norm"])
        self.query_key_value = _linear(weights["query_key_value"])
        self.attention_output = _linear(weights["attention_output"])
        self.mlp_norm = _norm(weights["mlp_norm"])
        self.mlp_hidden = _linear(weights["mlp_hidden"])
        self.mlp_output = _linear(weights["mlp_output"])

    def forward(
        self,
        token: Tensor,
        keys: Tensor,
        values: Tensor,
        turn: tuple[Tensor, Tensor],
        slot: Tensor,
        visible: Tensor,
    ) -> Tensor:
        """`[B, D]` to `[B, D]`, with rings that gain the token; slot `[B]`, visible `[B, W]`."""
        projected = self.query_key_value(self.attention_norm(token))
        query, key, value = projected.unflatten(-1, (3, self.heads, -1)).unbind(1)
        vehicle = torch.arange(len(token))
        keys[vehicle, :, slot] = _rotate(key, turn)
        values[vehicle, :, slot] = value
        attended = F.scaled_dot_product_attention(
            _rotate(query, turn)[:, :, None], keys, values, attn_mask=visible[:, None, None]
        )
        token = token + self.attention_output(attended.flatten(1))
        return token + self.mlp_output(F.silu(self.mlp_hidden(self.mlp_norm(token))))


class SpecialistNetwork(nn.Module):
    """`networks.specialist.SpecialistNetwork`, one token at a time."""

    cos: Tensor
    sin: Tensor

    def __init__(self, weights: Weights, size: NetworkSize, reduce: Weights | None = None):
        super().__init__()
        self.size, blocks = size, weights["transformer"]
        self.embed = _linear(weights["embed"])
        if reduce is not None:
            self.reduce = _linear(reduce)
            self.embed_ground = _linear(weights["embed_ground"])
        self.blocks = nn.ModuleList(
            Block(blocks[f"blocks_{i}"], size.heads) for i in range(size.layers)
        )
        self.norm = _norm(blocks["norm"])
        self.head = _linear(weights["head"])
        period = _PERIODS_A_WINDOW * WINDOW
        frequencies = np.geomspace(period / (2 * math.pi), 1.0, size.width // size.heads // 2)
        cycles = np.rint(frequencies).astype(np.int64)
        angle = np.arange(period)[:, None] * cycles % period * (2 * math.pi / period)
        self.register_buffer("cos", tensor(np.cos(angle).astype(np.float32)))
        self.register_buffer("sin", tensor(np.sin(angle).astype(np.float32)))

    def empty_cache(self, batch: int) -> Cache:
        """The cache before the first token."""
        shape = (batch, self.size.heads, WINDOW, self.size.width // self.size.heads)
        keys, values = ([torch.zeros(shape) for _ in self.blocks] for _ in range(2))
        return Cache(keys, values, torch.zeros(batch, dtype=torch.int64))

    def forward(
        self, features: Tensor, latent: Tensor | None, cache: Cache
    ) -> tuple[Tensor, Cache]:
        """`[B, F]` and the ground `[B, 36, 16, 16]`, if it sees it, to `[B, 12]`."""
        token = self.embed(features)
        if latent is not None:
            cells = self.reduce(latent.permute(0, 2, 3, 1))
            token = token + self.embed_ground(cells.flatten(1))
        position = cache.age % len(self.cos)
        turn = self.cos[position][:, None], self.sin[position][:, None]
        visible = torch.arange(WINDOW) <= cache.age[:, None]
        slot = cache.age % WINDOW
        for block, keys, values in zip(self.blocks, cache.keys, cache.values, strict=True):
            token = block(token, keys, values, turn, slot, visible)
        return self.head(self.norm(token)), cache._replace(age=cache.age + 1)


class Gate(nn.Module):
    """`networks.Gate`; its recurrent unit is PyTorch's."""

    def __init__(self, weights: Weights):
        super().__init__()
        self.embed = _linear(weights["Dense_0"])
        unit = {name: _linear(weights["TwoBiasGRU_0"][name]) for name in ("input", "state")}
        self.unit = nn.GRUCell(unit["input"].in_features, unit["state"].in_features)
        self.unit.weight_ih, self.unit.bias_ih = unit["input"].weight, unit["input"].bias
        self.unit.weight_hh, self.unit.bias_hh = unit["state"].weight, unit["state"].bias
        self.hidden = _linear(weights["Dense_1"])
        self.output = _linear(weights["Dense_2"])

    def forward(self, context: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """`[B, C]` and state `[B, 64]` to outputs `[B, 4]` and the next state."""
        hidden = self.unit(self.embed(context), hidden)
        features = F.silu(self.hidden(torch.cat([hidden, context], dim=-1)))
        return self.output(features), hidden


def _linear(weights: Weights) -> nn.Linear:
    made = nn.Linear(*weights["kernel"].shape, bias="bias" in weights)
    made.weight = nn.Parameter(tensor(weights["kernel"]).T.contiguous())
    if "bias" in weights:
        made.bias = nn.Parameter(tensor(weights["bias"]))
    return made


def _convolution(kernel: Any, bias: Any, stride: int = 1, padding: int = 0) -> nn.Conv2d:
    """From flax's kernel, `[height, width, in, out]`."""
    side, _, planes, features = kernel.shape
    made = nn.Conv2d(planes, features, side, stride, padding)
    made.weight = nn.Parameter(tensor(kernel).permute(3, 2, 0, 1).contiguous())
    made.bias = nn.Parameter(tensor(bias))
    return made


def _norm(weights: Weights) -> nn.RMSNorm:
    made = nn.RMSNorm(len(weights["scale"]), eps=_NORM_EPSILON)
    made.weight = nn.Parameter(tensor(weights["scale"]))
    return made


def _rotate(vectors: Tensor, turn: tuple[Tensor, Tensor]) -> Tensor:
    """Turns each pair (i, d / 2 + i) of `[B, heads, d]` by `[B, 1, d / 2]` cosines and sines."""
    (cos, sin), (first, second) = turn, vectors.chunk(2, dim=-1)
    return torch.cat([first * cos - second * sin, first * sin + second * cos], dim=-1)
