"""What a model sees by, and what it makes of the ground at a pose."""

from collections.abc import Callable
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.networks.encoder import LATENT_CHANNELS, TerrainEncoder
from vertiwm_jax.networks.soil_predictor import SoilPredictor
from vertiwm_jax.terrain.patches import PATCH_PIXELS, Patches
from vertiwm_jax.terrain.soil import Soil

EMBEDDING_SHAPE = (16, 16, 2 * LATENT_CHANNELS)
"""Of latents: rows, the first farthest ahead; columns, the first farthest left; and channels."""
CELLS = EMBEDDING_SHAPE[0] * EMBEDDING_SHAPE[1]
_ELEVATION, _SEMANTIC, _SOIL = TerrainEncoder(1), TerrainEncoder(3), SoilPredictor()


@struct.dataclass
class Encoders:
    """Weights by which a model sees.

    elevation, semantic: of the pair of `TerrainEncoder`s; frozen.
    reduce: `kernel` `[36, C]` and `bias` `[C]`, the first layer of the Transformer's network, which
        is the same for each of 256 cells and is learned with it; None if no network reads cells.
    soil: of the `SoilPredictor`, frozen; None where soils are those of the map.
    """

    elevation: Any
    semantic: Any
    reduce: Any = None
    soil: Any = None


@struct.dataclass
class TerrainFeatures:
    """What is seen at a pose.

    average: `[..., 36]` the mean of every latent channel over space, e of Eq. 4.
    reduced: `[..., 256 C]` what `Encoders.reduce` makes of each cell, row by row; None without it.
    soil: leaves `[...]`, its unit weight 0; None without `Encoders.soil`.
    latents: `[..., 16, 16, 36]` z of Eq. 1, elevation first; None unless they were asked for.
    """

    average: jax.Array
    reduced: jax.Array | None = None
    soil: Soil | None = None
    latents: jax.Array | None = None


def init_pair(key: jax.Array) -> Encoders:
    """An untrained pair of encoders."""
    keys = jax.random.split(key)
    patch = jnp.zeros((PATCH_PIXELS, PATCH_PIXELS, 3))
    return Encoders(_ELEVATION.init(keys[0], patch[..., :1]), _SEMANTIC.init(keys[1], patch))


def init_reduce(key: jax.Array, channels: int) -> Any:
    """Untrained `Encoders.reduce`."""
    params = _Reducing(channels).init(key, jnp.zeros(EMBEDDING_SHAPE[-1]))
    return cast(Any, params)["params"]["reduce"]


def init_soil(key: jax.Array) -> Any:
    """Untrained `Encoders.soil`."""
    return _SOIL.init(key, jnp.zeros((*EMBEDDING_SHAPE[:2], LATENT_CHANNELS)))


def encode(encoders: Encoders, patches: Patches) -> tuple[jax.Array, jax.Array]:
    """Patches to their latents of elevation and of colors, each `[..., 16, 16, 18]` (Eq. 1)."""
    elevation = _ELEVATION.apply(encoders.elevation, patches.elevation[..., None])
    semantic = _SEMANTIC.apply(encoders.semantic, patches.rgb)
    return cast(jax.Array, elevation), cast(jax.Array, semantic)


def features(
    encoders: Encoders,
    elevation: jax.Array,
    semantic: jax.Array,
    keep: bool,
    in_rows: Callable[[jax.Array], jax.Array] = lambda cells: cells,
) -> TerrainFeatures:
    """What is read of one vehicle's latents `[16, 16, 18]`, and they themselves if they are kept.

    in_rows: brings cells `[..., c]` that are given in another order to `[16, 16, c]`.
    """
    over_space = tuple(range(elevation.ndim - 1))
    both, reduced, soil = (elevation, semantic), None, None
    if encoders.reduce is not None:
        reduced = in_rows(reduce(encoders.reduce, *both)).ravel()
    if encoders.soil is not None:
        soil = cast(Soil, _SOIL.apply(encoders.soil, in_rows(semantic)))
    return TerrainFeatures(
        average=jnp.concatenate([jnp.mean(x, axis=over_space) for x in both]),
        reduced=reduced,
        soil=soil,
        latents=in_rows(jnp.concatenate(both, axis=-1)) if keep else None,
    )


def reduce(weights: Any, elevation: jax.Array, semantic: jax.Array) -> jax.Array:
    """Latents `[..., 18]` of each cell to `[..., C]`, without a copy of them beside each other."""
    of_elevation, of_semantic = jnp.split(weights["kernel"], 2)
    return elevation @ of_elevation + semantic @ of_semantic + weights["bias"]


class _Reducing(nn.Module):
    """A `nn.Dense` by the name that decides which weights it begins with."""

    channels: int

    def setup(self) -> None:
        self.reduce = nn.Dense(self.channels)

    def __call__(self, latents: jax.Array) -> jax.Array:
        return self.reduce(latents)
