"""Windows of recorded drives as what a model is fitted to and validated on."""

from dataclasses import dataclass, replace
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax import parallel
from vertiwm_jax.config import ConfigError, Count, CountOrZero, NotNegative, settings
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.learning import augment, windows
from vertiwm_jax.learning.dataset import Drives
from vertiwm_jax.learning.objectives import Objective, open_loop
from vertiwm_jax.learning.windows import GROUNDS, WindowIndex, Windows
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.terrain.map import TerrainMap


@settings
class WindowConfig:
    """Which windows a model is fitted to and validated on."""

    batch: Count = 64
    """Windows in a batch."""
    context: CountOrZero = 16
    """Recorded steps that a model sees first."""
    horizon: Count = 16
    """Steps that it predicts."""
    stride: Count = 4
    """Steps from one window to the next."""
    weights: tuple[NotNegative, NotNegative, NotNegative] = (1.0, 1.0, 1.0)
    """How often a window on rigid ground, on soil and across both is drawn, relatively."""
    mirror: bool = True
    """Whether half of those drawn are replaced by their mirror images."""
    validation: Count = 256
    """Largest number of windows of each kind of ground to validate on."""


@struct.dataclass
class WindowData:
    """Windows to fit to, and others to validate on, with their ground.

    drives, index: where the N windows lie; share: `[N]` the chance that a window or one before it
    is drawn; terrain: with the mirror images of its worlds if windows are mirrored.
    vehicles, validation_vehicles: leaves `[W, ...]`, by world; None where parameters hold the one.
    """

    drives: Drives
    index: WindowIndex
    share: jax.Array
    terrain: TerrainMap
    validation: Windows
    validation_terrain: TerrainMap
    vehicles: Vehicle | None = None
    validation_vehicles: Vehicle | None = None

    @classmethod
    def of(
        cls,
        config: WindowConfig,
        training: tuple[Drives, TerrainMap],
        validation: tuple[Drives, TerrainMap],
        otherwise: Vehicle | None = None,
    ) -> Self:
        """All windows of the training drives, and some of the validation drives.

        otherwise: if vehicles are those that files describe, the one where a file describes none.

        Raises `DataError` when drives are too short, `MapError` when maps cannot be mirrored,
        `ConfigError` when no window has a chance to be drawn.
        """
        lengths = config.context, config.horizon, config.stride
        index = windows.index(*training, *lengths)
        chance = np.asarray(config.weights)[np.asarray(index.ground)].cumsum()
        if chance[-1] == 0:
            raise ConfigError("weights: expected one above 0 of the ground driven on, found none")
        drives, terrain = training
        held_out = windows.index(*validation, *lengths)
        rows = _spread(np.asarray(held_out.ground), config.validation)
        return cls(
            drives=jax.device_put(drives),
            index=index,
            share=jnp.asarray(chance / chance[-1], jnp.float32),
            terrain=augment.with_mirrored(terrain) if config.mirror else terrain,
            validation=windows.gather(validation[0], held_out, rows),
            validation_terrain=validation[1],
            vehicles=otherwise and drives.driven(otherwise),
            validation_vehicles=otherwise and validation[0].driven(otherwise),
        )


@dataclass(frozen=True)
class WindowProblem:
    """A `fitting.Problem`: parameters of `dynamics` that keep `objective` small on windows.

    Validated is the mean position error, m, after the last step of open-loop predictions by kind
    of ground; `error` is the mean over the kinds.
    """

    dynamics: Dynamics
    objective: Objective
    config: WindowConfig

    def loss(self, params: Params, data: WindowData, key: jax.Array) -> jax.Array:
        """The mean objective `[]` of a batch of windows."""
        draw_key, mirror_key = jax.random.split(key)
        uniform = jax.random.uniform(draw_key, (self.config.batch,))
        rows = jnp.searchsorted(data.share, uniform, side="right")
        batch = windows.gather(data.drives, data.index, rows)
        if self.config.mirror:
            batch = augment.mirror_some(mirror_key, batch, data.terrain)

        def one(
            params: Params, terrain: TerrainMap, vehicles: Vehicle | None, window: Windows
        ) -> jax.Array:
            own = driven_in(params, vehicles, window.world)
            return self.objective(own, terrain.select(window.world), window)

        every = parallel.vmap(one, (None, None, None, 0))
        return jnp.mean(every(params, data.terrain, data.vehicles, batch))

    def validate(self, params: Params, data: WindowData) -> dict[str, jax.Array]:
        """Position errors, m; a prediction that is not finite counts as not having moved."""

        def one(
            params: Params, terrain: TerrainMap, vehicles: Vehicle | None, window: Windows
        ) -> tuple[jax.Array, jax.Array]:
            terrain = terrain.select(window.world)
            own = driven_in(params, vehicles, window.world)
            predicted, _ = open_loop(self.dynamics, own, terrain, window)
            truth, start = window.state[-1, :3], window.state[window.context, :3]
            error = jnp.linalg.norm(predicted.position[-1] - truth)
            lost = ~jnp.isfinite(error)
            return jnp.where(lost, jnp.linalg.norm(start - truth), error), lost

        every = parallel.vmap(one, (None, None, None, 0), self.config.batch)
        where = data.validation_terrain, data.validation_vehicles
        error, lost = every(params, *where, data.validation)
        kinds = data.validation.ground == jnp.arange(len(GROUNDS))[:, None]
        means = jnp.sum(kinds * error, axis=1) / jnp.sum(kinds, axis=1)
        by_kind = {f"error_{kind}": mean for kind, mean in zip(GROUNDS, means, strict=True)}
        return {**by_kind, "error": jnp.nanmean(means), "diverged": jnp.mean(lost)}


def driven_in(params: Params, vehicles: Vehicle | None, world: jax.Array) -> Params:
    """The parameters with the vehicle of a world `[]`, also of the mirror image of one."""
    if vehicles is None:
        return params
    return replace(params, vehicle=vehicles.select(world % len(vehicles.mass)))


def _spread(ground: np.ndarray, most: int) -> np.ndarray:
    """Rows of at most `most` windows of each kind, evenly spread over all of them, in order."""
    rows = []
    for kind in range(len(GROUNDS)):
        found = np.flatnonzero(ground == kind)
        rows.append(found[np.linspace(0, len(found) - 1, min(most, len(found))).astype(int)])
    return np.sort(np.concatenate(rows))
