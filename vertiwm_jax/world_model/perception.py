"""What a model perceives of the ground at a pose: queried patches and their latents (Eq. 2)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol, cast

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.dynamics import Dynamics, History, Params
from vertiwm_jax.networks.encoder import Fours, TerrainEncoder, in_rows
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import cells, patches
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.patches import PATCH_PIXELS, Patches
from vertiwm_jax.world_model.batching import few_at_a_time

_ELEVATION, _SEMANTIC = TerrainEncoder(1), TerrainEncoder(3)
TOGETHER = 16
"""Vehicles that look at a time, whose patches of 260 kB each stay near a core."""


@struct.dataclass
class Perception:
    """The latents of the patches at a pose, Z of Eq. 2.

    elevation, semantic: `[..., 16, 16, 18]`; row 0 farthest ahead, column 0 farthest left.
    """

    elevation: jax.Array
    semantic: jax.Array

    @property
    def latent(self) -> jax.Array:
        """`[..., 16, 16, 36]` both, channel by channel; flat, it is z of Eq. 2."""
        return jnp.concatenate([self.elevation, self.semantic], axis=-1)

    @property
    def averaged(self) -> jax.Array:
        """`[..., 36]` the mean of every channel over space, e of Eq. 5."""
        means = [jnp.mean(x, axis=(-3, -2)) for x in (self.elevation, self.semantic)]
        return jnp.concatenate(means, axis=-1)


@struct.dataclass
class Glance:
    """What a model goes on with of a `Perception`, without latents.

    averaged: `[..., 36]` as that of `Perception`.
    reduced: `[..., 256 C]` the C numbers that the Transformer's network makes of each cell; None
        for a model whose network does not read the ground.
    """

    averaged: jax.Array
    reduced: jax.Array | None = None


@struct.dataclass
class EncoderParams:
    """Weights of a pair of `TerrainEncoder`s, for elevation and for semantic colours."""

    elevation: Any
    semantic: Any


Remembers = Literal["latents", "glance"]
"""What a model's history has of a look; see `world_model.choice.lean`."""
Keep = Callable[[Any, Fours, Fours], Perception | Glance]
"""Makes that of weights, if it needs some, and of latents of elevation and of colours."""


def latents(_: Any, elevation: Fours, semantic: Fours) -> Perception:
    """All of a look."""
    return Perception(in_rows(elevation.latent), in_rows(semantic.latent))


def glance(_: Any, elevation: Fours, semantic: Fours) -> Glance:
    """The averages of the same."""
    return Glance(jnp.concatenate([elevation.mean, semantic.mean]))


@struct.dataclass
class View:
    """How one model looks at the ground.

    keep: what it remembers, like `latents` and `glance`; static.
    weights: which `keep` is given first.
    """

    encoders: EncoderParams
    keep: Keep = struct.field(pytree_node=False, default=latents)
    weights: Any = None


@dataclass(frozen=True)
class Exteroception:
    """How a model looks at the ground, by encoders of its own, which are frozen."""

    def init_params(self, key: jax.Array) -> EncoderParams:
        """Untrained encoders."""
        keys = jax.random.split(key)
        patch = jnp.zeros((PATCH_PIXELS, PATCH_PIXELS, 3))
        return EncoderParams(
            _ELEVATION.init(keys[0], patch[..., :1]), _SEMANTIC.init(keys[1], patch)
        )

    def look(
        self, views: tuple[View, ...], terrain: TerrainMap, state: VehicleState
    ) -> tuple[Perception | Glance, ...]:
        """What models see at one vehicle's pose, all of the same patches.

        The map counts as given, like the pose: no gradient flows.
        """
        given = jax.lax.stop_gradient((views, terrain, state))
        return few_at_a_time(Exteroception._look, TOGETHER, self)(*given)

    def _look(
        self, views: tuple[View, ...], terrain: TerrainMap, state: VehicleState
    ) -> tuple[Perception | Glance, ...]:
        """`encode` of `query`, to rounding. Most pixels need not be drawn."""
        encoders = [view.encoders for view in views]
        of_elevation, of_semantic = (
            jnp.concatenate([params["params"]["cell_kernel"] for params in kind], axis=-1)
            for kind in ([p.elevation for p in encoders], [p.semantic for p in encoders])
        )
        projected = cells.projections(
            terrain, state.position, state.rpy[2], of_elevation[0], of_semantic
        )
        of_each = zip(*(jnp.split(x, len(views), axis=-1) for x in projected), strict=True)
        return tuple(
            view.keep(
                view.weights,
                _of_fours(_ELEVATION, view.encoders.elevation, elevation),
                _of_fours(_SEMANTIC, view.encoders.semantic, semantic),
            )
            for view, (elevation, semantic) in zip(views, of_each, strict=True)
        )

    def query(self, terrain: TerrainMap, state: VehicleState) -> Patches:
        """The patches at one vehicle's pose, which counts as given: Q(M; sg(T))."""
        return patches.query(terrain, state.position, state.rpy[2])

    def encode(self, params: EncoderParams, seen: Patches) -> Perception:
        """Patches to their latents (Eq. 2)."""
        params = jax.lax.stop_gradient(params)
        elevation = _ELEVATION.apply(params.elevation, seen.elevation[..., None])
        semantic = _SEMANTIC.apply(params.semantic, seen.rgb)
        return Perception(cast(jax.Array, elevation), cast(jax.Array, semantic))


def _of_fours(encoder: TerrainEncoder, params: Any, projected: jax.Array) -> Fours:
    return cast(Fours, encoder.apply(params, projected, method=TerrainEncoder.of_fours))


@struct.dataclass
class Eyes:
    """Encoders that look at the ground, apart from any model.

    exteroception: how they look, static; params: their weights.
    """

    exteroception: Exteroception = struct.field(pytree_node=False)
    params: EncoderParams

    def __call__(self, terrain: TerrainMap, state: VehicleState) -> Perception:
        """What they see at one vehicle's pose."""
        (perception,) = self.exteroception.look((View(self.params),), terrain, state)
        return cast(Perception, perception)


@struct.dataclass
class SightedParams:
    """dynamics: of the model that moves; eyes: what it is made to see by."""

    dynamics: Params
    eyes: Eyes


@struct.dataclass
class SightedHistory:
    """history: of the model that moves; perception: of the current state."""

    history: History
    perception: Perception


@dataclass(frozen=True)
class Sighted:
    """Any `Dynamics`, with what encoders see at each state in its history: moves as it does.

    For policies that see the ground by a world model's encoders and drive in something else.
    """

    dynamics: Dynamics

    def init(
        self, params: SightedParams, terrain: TerrainMap, state: VehicleState
    ) -> SightedHistory:
        """The model's history, and a look at the ground."""
        history = self.dynamics.init(params.dynamics, terrain, state)
        return SightedHistory(history, params.eyes(terrain, state))

    def step(
        self,
        params: SightedParams,
        terrain: TerrainMap,
        history: SightedHistory,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, SightedHistory]:
        """The model's next state, and a look at the ground there."""
        state, moved = self.dynamics.step(params.dynamics, terrain, history.history, state, command)
        return state, SightedHistory(moved, params.eyes(terrain, state))


class Specialist(Dynamics, Protocol):
    """A `Dynamics` whose step is a proposal, and then a look at where it leads.

    Its history has a field `perception` and can be changed with `dataclasses.replace`. The fused
    model lets both specialists propose, fuses, and gives each its perception of the fused state.
    """

    @property
    def exteroception(self) -> Exteroception: ...

    def view(self, params: Params) -> View:
        """How `history.perception` is seen by that."""
        ...

    def begin(self, params: Params, terrain: TerrainMap, state: VehicleState) -> History:
        """`init` without the look: `history.perception` is None."""
        ...

    def propose(
        self,
        params: Params,
        terrain: TerrainMap,
        history: History,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, History]:
        """`step` up to the next state; `history.perception` is still that of `state`."""
        ...
