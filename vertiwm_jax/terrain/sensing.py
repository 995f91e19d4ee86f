"""Limited sensing: what a vehicle has seen of its map, what it assumes of the rest, and errors."""

import math
from dataclasses import replace
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.config import Bounds, ConfigError, Count, NotNegative, Positive, Share, settings
from vertiwm_jax.terrain import _raster, query
from vertiwm_jax.terrain.map import ObservedMap, TerrainMap

NEAR = 4.0
"""Distance, m, within which a vehicle knows the ground in all directions."""
_RINGS, _DIRECTIONS = 6, 12  # of the places in view that the plane is laid through
_FAR = 20.0  # m, of them
_Angle = Bounds("more than 0 and at most 6.28319", lambda x: 0 < x <= 2 * math.pi)


@settings
class SensingConfig:
    """What sensors see of the map; by default all of it is known from the start."""

    range: Positive = math.inf
    """Distance, m, at which ground, and obstacles by their middle, are seen."""
    field_of_view: Annotated[float, _Angle] = 2 * math.pi
    """Angle of view, rad, centered ahead. Ground nearer than 4 m is always seen."""
    cells: Count = 64
    """Cells along each side of the map; each cell is known or not."""
    missing: Share = 0.0
    """Share of the cells that are missing on the map, and are never seen."""
    height_noise: NotNegative = 0.0
    """Standard deviation, m, of the error of each height of the map."""
    displaced: NotNegative = 0.0
    """Distance, m, by which the map lies beside the ground, in a direction of each episode."""

    @property
    def partial(self) -> bool:
        """Whether some of the map is unknown at the start."""
        return math.isfinite(self.range)

    @property
    def exact(self) -> bool:
        """Whether all of the map is known as it is."""
        return not (self.partial or self.missing or self.height_noise or self.displaced)


def check(config: SensingConfig, terrain: TerrainMap) -> None:
    """`ValueError` if cells are so large that a vehicle may not see the cell that it stands in."""
    width, height = terrain.size.tolist()
    least = math.ceil(math.hypot(width, height) / (2 * min(config.range, NEAR)))
    if config.partial and config.cells < least:
        raise ConfigError(
            f"sensing.cells: expected at least {least} on a map of {width:g} x {height:g} m with a "
            f"range of {config.range:g} m, found {config.cells}"
        )


def look(
    config: SensingConfig,
    terrain: TerrainMap,
    position: jax.Array,
    yaw: jax.Array,
    seed: jax.Array | int = 0,
) -> ObservedMap:
    """What is known after looking around at `[3]` p_world, m, and `[]` yaw, rad.

    terrain: as it was observed before; at the first look, all of it. A cell is seen where its
    middle is, and stays known. Unknown ground is assumed to lie in the least-squares plane through
    the ground in view, with class and friction of the ground below the vehicle.
    seed: draws the errors of the map at the first look.
    """
    observed = terrain.observed
    if observed is None:
        below, seed = query.surface(terrain, position[:2]), jnp.asarray(seed, jnp.uint32)
        turn = 2 * jnp.pi * _raster.uniform(jnp.uint32(0), seed)
        observed = ObservedMap(
            known=jnp.zeros((config.cells, config.cells), bool),
            plane=jnp.stack([below.height, *jnp.zeros(2)]),
            semantic=below.semantic,
            friction=below.friction,
            seed=seed,
            noise=jnp.float32(config.height_noise) if config.height_noise else None,
            displaced=config.displaced * jnp.stack([jnp.cos(turn), jnp.sin(turn)]),
        )
    position = position.at[:2].add(observed.displaced)
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    middles = (np.arange(config.cells, dtype=np.float32) + 0.5) / config.cells
    _, rows, columns = terrain.elevation.shape
    east = terrain.origin[0] + middles * ((columns - 1) * terrain.resolution) - position[0]
    north = terrain.origin[1] - middles * ((rows - 1) * terrain.resolution) - position[1]
    squared = east**2 + north[:, None] ** 2
    seen = squared <= config.range**2
    if config.field_of_view < 2 * math.pi:
        ahead = cos * east + (sin * north)[:, None]
        in_view = ahead >= math.cos(config.field_of_view / 2) * jnp.sqrt(squared)
        seen &= in_view | (squared <= NEAR**2)
    if config.missing:
        cells = jnp.arange(config.cells**2, dtype=jnp.uint32).reshape(seen.shape)
        seen &= _raster.uniform(cells, observed.seed + 1) >= config.missing
    observed = replace(observed, known=observed.known | seen)

    # As observed, so that places in cells that are not seen tell nothing.
    ground = replace(terrain, observed=observed)
    forward, left = _places(config)
    x, y = cos * forward - sin * left, sin * forward + cos * left
    heights = query.height(ground, position[:2] + jnp.stack([x, y], axis=-1))
    fit = np.linalg.pinv(np.stack([np.ones_like(forward), forward, left], axis=-1))
    level, rise, bank = jnp.dot(fit.astype(np.float32), heights, precision="highest")
    slope = jnp.stack([cos * rise - sin * bank, sin * rise + cos * bank])
    below = query.surface(ground, position[:2])
    return replace(
        observed,
        plane=jnp.append(level - jnp.sum(slope * position[:2]), slope),
        semantic=below.semantic,
        friction=below.friction,
    )


def _places(config: SensingConfig) -> np.ndarray:
    """`[2, P]` m ahead and to the left, evenly over what is in view."""
    rings = min(config.range, _FAR) * np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)
    turns = config.field_of_view * ((np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS - 0.5)
    radius, angle = (x.ravel() for x in np.meshgrid(rings, turns))
    return (radius * np.stack([np.cos(angle), np.sin(angle)])).astype(np.float32)
