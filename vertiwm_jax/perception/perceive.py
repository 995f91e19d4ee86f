"""The look at the ground: the only way by which models and policies see it (Eq. 1)."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from vertiwm_jax.perception import _fast
from vertiwm_jax.perception.features import Encoders, TerrainFeatures, encode, features, reduce
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain import patches
from vertiwm_jax.terrain.map import TerrainMap


def perceive(
    encoders: tuple[Encoders, ...], terrain: TerrainMap, state: VehicleState, latents: bool = False
) -> tuple[TerrainFeatures, ...]:
    """What each pair of encoders makes of the ground at one vehicle's pose, Q(M; sg(T)).

    Batch with `vmap`, selecting each vehicle's world inside. Map, pose and encoders count as given:
    no gradient flows to them.

    Args:
        encoders: one pair for all that look, or one for each.
        terrain: the map, its world selected.
        state: leaves `[3]`.
        latents: whether those of the first pair are kept, for a policy to see them, or for
            `Encoders.reduce` of the first pair to be learned; `reduced` then gives the features
            that are left out. Without them a gradient of `Encoders.reduce` raises.

    Returns:
        Features of each pair.
    """
    first, *others = encoders
    looking = replace(first, reduce=None) if latents else _without_gradient(first)
    return jax.lax.platform_dependent(
        *jax.lax.stop_gradient(((looking, *map(_without_gradient, others)), terrain, state)),
        cpu=partial(_fast.look, latents=latents),
        default=partial(_plain, latents=latents),
    )


def reduced(
    encoders: tuple[Encoders, ...], features: tuple[TerrainFeatures, ...]
) -> tuple[TerrainFeatures, ...]:
    """Features of `perceive`, with what `Encoders.reduce` makes of latents that were kept."""
    first, *others = features
    if first.latents is None or encoders[0].reduce is None:
        return features
    latents = jnp.split(first.latents, 2, axis=-1)
    return (replace(first, reduced=reduce(encoders[0].reduce, *latents).ravel()), *others)


def embed(encoders: Encoders, terrain: TerrainMap, state: VehicleState) -> jax.Array:
    """`[16, 16, 36]` latents of the ground at one vehicle's pose, as policies see them."""
    (features,) = perceive((encoders,), terrain, state, latents=True)
    assert features.latents is not None
    return features.latents


def _plain(
    encoders: tuple[Encoders, ...], terrain: TerrainMap, state: VehicleState, latents: bool = False
) -> tuple[TerrainFeatures, ...]:
    """Draws the patches and encodes them."""
    seen = patches.query(terrain, state.position, state.rpy[2])
    return tuple(
        features(pair, *encode(pair, seen), keep=latents and i == 0)
        for i, pair in enumerate(encoders)
    )


def _without_gradient(pair: Encoders) -> Encoders:
    return pair if pair.reduce is None else replace(pair, reduce=_not_learned(pair.reduce))


@jax.custom_jvp
def _not_learned(weights: Any) -> Any:
    return weights


@_not_learned.defjvp
def _raise(primals: Any, tangents: Any) -> Any:
    raise TypeError(
        "encoders.reduce: expected a model that keeps latents, to learn it; found one that does "
        "not (`latents` of VertiWM and Alone)"
    )
