"""Procedural worlds, drawn on the device from keys: relief, ground classes, obstacles.

The scale is Verti-Bench's: 128 m x 128 m, one vertex a meter, 8 m class cells, and presets of
difficulty with the median slope of its low, mid and high worlds, and one beyond.
"""

import functools
from dataclasses import replace
from itertools import cycle, islice, product
from typing import Annotated, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax import froude, kept
from vertiwm_jax.config import AtLeastOne, Bounds, CountOrZero, Share, settings
from vertiwm_jax.precision import float32
from vertiwm_jax.terrain.classes import FIRST_DEFORMABLE, STANDARD
from vertiwm_jax.terrain.map import BY_WORLD, TerrainMap

VERTICES = 129
RESOLUTION = 1.0
CELLS = 16
HALF_EXTENT = 64.0
HIGHEST = 16.0
"""Height of the ground at most, m, which is that of Verti-Bench's worlds."""
START_RADIUS = 60.0
"""Starts and goals lie on a circle of this radius about the center, m."""
START_CLEARANCE = 6.0
"""No obstacle comes nearer to that circle than this, m."""
ROCK_SIZE = (4.4, 4.4, 3.8)
TREE_SIZE = (1.0, 1.0, 5.0)

Difficulty = Literal["low", "mid", "high", "extreme"]
Kind = Literal["rigid", "deformable", "mixed"]

MEDIAN_SLOPE_DEG: dict[Difficulty, float] = {"low": 5.8, "mid": 11.3, "high": 18.5, "extreme": 25.0}
"""Median slope of the triangles of the ground; the first three are means over Verti-Bench."""

_KINDS: tuple[Kind, ...] = get_args(Kind)
_SLOPE_SPREAD = 0.1
_FRICTION_LIMITS = (0.1, 1.0)
# Of each class between patches, in Verti-Bench.
_FRICTION_DEVIATION = np.array([0.05, 0.08, 0.1, 0.07, 0.1, 0.08, 0.06, 0, 0, 0], np.float32)
_FFT_PERIOD = 256  # the smallest power of two that holds the map without wrapping around
_VORONOI_CELLS = 10


def _has_slope(difficulty: Difficulty | float) -> bool:
    named = difficulty in MEDIAN_SLOPE_DEG
    return named or (not isinstance(difficulty, str) and 0 <= difficulty < 60)


_Slope = Bounds("a median slope of 0 to 60 deg, or one", _has_slope)
_Difficulties = Annotated[tuple[Difficulty | float, ...], AtLeastOne, _Slope]


@settings
class WorldConfig:
    """Settings of procedural worlds, which cycle through all pairs of difficulty and kind.

    difficulties: preset names, or median slopes in degrees.
    kinds: rigid ground, soil, or rectangles of soil in rigid ground.
    rocks, trees: number of each in a world with obstacles.
    obstructed: probability that a world has obstacles.
    """

    difficulties: _Difficulties = ("low", "mid", "high")
    kinds: Annotated[tuple[Kind, ...], AtLeastOne, Bounds("one", _KINDS.__contains__)] = _KINDS
    rocks: CountOrZero = 0
    trees: CountOrZero = 0
    obstructed: Share = 1.0


def labels(config: WorldConfig, count: int) -> list[tuple[Difficulty | float, Kind]]:
    """The difficulty and kind of each of `count` worlds."""
    pairs = product(config.kinds, config.difficulties)
    return [(difficulty, kind) for kind, difficulty in islice(cycle(pairs), count)]


@float32
def generate(keys: jax.Array, config: WorldConfig, scale: float = 1.0) -> TerrainMap:
    """Draws one world for each of the typed keys `[W]`, on the device; deterministic.

    scale: of a small vehicle that is brought to full size, where soils are scaled: the
        worlds are as large as ever there, and so small to the vehicle itself.
    """
    wanted = labels(config, len(keys))
    slope = [MEDIAN_SLOPE_DEG[d] if isinstance(d, str) else d for d, _ in wanted]
    kind = [_KINDS.index(k) for _, k in wanted]
    # One after the other: `vmap` would be no faster, compile twice as long, and take W times the
    # memory for the transforms; and so every number of worlds runs the same program.
    parts = [
        (
            *_ground(keys[i], np.float32(slope[i]), np.int32(kind[i])),
            _obstacles(keys[i], config.rocks, config.trees, config.obstructed),
        )
        for i in range(len(keys))
    ]
    soils = froude.scaled(STANDARD.stacked_soils(), scale)
    # By NumPy: to stack so many arrays would be a program for every number of worlds.
    stacked = map(np.stack, zip(*jax.device_get(parts), strict=True))
    drawn = dict(zip(BY_WORLD, map(jnp.asarray, stacked), strict=True))
    level = TerrainMap.from_array(np.zeros((VERTICES, VERTICES)), np.zeros((CELLS, CELLS), int))
    return replace(level, **drawn, soils=jax.tree.map(lambda leaf: leaf[None], soils))


@float32
def make_worlds(
    number: int = 1, seed: int = 0, config: WorldConfig = WorldConfig(), *, scale: float = 1.0
) -> TerrainMap:
    """Draws procedural worlds of 128 m x 128 m.

    Args:
        number: how many.
        seed: decides what they look like.
        config: their ground, slopes and obstacles, in turns.
        scale: of a small vehicle that is brought to full size, as in its file.

    Returns:
        A map of W = `number` worlds, of which the first is selected.
    """
    return generate(jax.random.split(jax.random.key(seed), number), config, scale)


@kept.jit
def _ground(
    key: jax.Array, slope_deg: jax.Array, kind: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Elevation, semantic classes and friction of one world."""
    relief_key, class_key, friction_key, _ = jax.random.split(key, 4)
    semantic = _classes(class_key, kind)
    return _relief(relief_key, slope_deg), semantic, _friction(friction_key, semantic)


def _relief(key: jax.Array, slope_deg: jax.Array) -> jax.Array:
    """`[129, 129]` heights from 0 up, m, whose triangles have the median slope, give or take."""
    noise_key, ridge_key, scalar_key = jax.random.split(key, 3)
    # One draw for all scalars: every call of the generator costs compile time.
    uniform = iter(jax.random.uniform(scalar_key, (9,)))

    def between(low: float, high: float) -> jax.Array:
        return low + (high - low) * next(uniform)

    # Of the roughness, of its differences between places, and of hills.
    exponent = jnp.stack([between(0.6, 1.4), jnp.float32(1), jnp.float32(2)])
    shortest = jnp.stack([between(2.2, 3.5), jnp.float32(12), jnp.float32(25)])
    longest = jnp.stack([between(20.0, 60.0), jnp.float32(60), jnp.float32(130)])
    rough, patches, hills = _noises(noise_key, exponent, shortest, longest)
    rough = rough / _median_slope(rough) * jnp.exp(0.4 * patches)
    # Squared, so that most worlds are rough and some are rolling.
    hills = 5.0 * between(0, 1) ** 2 * hills
    axis = jnp.arange(VERTICES) * RESOLUTION - HALF_EXTENT
    x, y = axis[None, :], -axis[:, None]
    ridges = _ridges(ridge_key, x, y)

    # A nearly level clearing in some worlds.
    squared = (x - between(-40, 40)) ** 2 + (y - between(-40, 40)) ** 2
    inside = jnp.exp(-((squared / between(10, 25) ** 2) ** 2))
    level = jnp.where(between(0, 1) < 0.4, 0.85, 0.0) * inside
    heights = (rough + ridges) * (1 - level) + hills

    slope = jnp.tan(jnp.deg2rad(slope_deg)) * between(1 - _SLOPE_SPREAD, 1 + _SLOPE_SPREAD)
    heights *= slope / _median_slope(heights)
    heights -= jnp.min(heights)
    # Rarely, long steep hills would be higher than any of Verti-Bench.
    return heights * jnp.minimum(1.0, HIGHEST / jnp.maximum(jnp.max(heights), 1e-6))


def _noises(
    key: jax.Array, exponent: jax.Array, shortest: jax.Array, longest: jax.Array
) -> jax.Array:
    """`[n, 129, 129]` fields of power-law noise between two wavelengths in m, of unit deviation.

    exponent: `[n]` fall of the amplitude spectrum with spatial frequency; larger is smoother.
    """
    axis = np.fft.fftfreq(_FFT_PERIOD, RESOLUTION)
    frequency = np.hypot(axis[:, None], axis[None, :])
    frequency[0, 0] = 1e-3  # outside every band; keeps the power finite
    exponent, low, high = (x[:, None, None] for x in (exponent, shortest, longest))
    band = (frequency > 1 / high) & (frequency < 1 / low)
    amplitude = jnp.where(band, frequency**-exponent, 0.0)
    phase = jax.random.uniform(key, amplitude.shape, maxval=2 * np.pi)
    fields = jnp.fft.ifft2(amplitude * jnp.exp(1j * phase)).real[:, :VERTICES, :VERTICES]
    return fields / jnp.std(fields, axis=(1, 2), keepdims=True)


def _median_slope(heights: jax.Array) -> jax.Array:
    """Median slope (a tangent) of the lower triangles of all cells."""
    right = heights[1:, 1:] - heights[1:, :-1]
    up = heights[:-1, 1:] - heights[1:, 1:]
    # As integers, which XLA sorts four times as fast: the bits of floats that are not negative are
    # in the same order.
    bits = jax.lax.bitcast_convert_type(jnp.hypot(right, up), jnp.int32).ravel()
    middle = jnp.sort(bits)[np.array([bits.size - 1, bits.size]) // 2]
    return jnp.mean(jax.lax.bitcast_convert_type(middle, jnp.float32)) / RESOLUTION


def _ridges(key: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """The sum of 0 to 4 straight ridges (up) and ditches (down) over points x, y."""
    low = jnp.array([0, -50, -40, 1.2, 15, -4])
    high = jnp.array([2 * np.pi, 50, 40, 5, 60, 4])
    drawn = jax.random.uniform(key, (4, 6), minval=low, maxval=high)
    angle, offset, middle, width, length, rise = jnp.moveaxis(drawn, 1, 0)[..., None, None]
    across = (x * jnp.cos(angle) + y * jnp.sin(angle) - offset) / width
    along = (y * jnp.cos(angle) - x * jnp.sin(angle) - middle) / length
    # Those that would rise or fall by little are left out.
    rise = jnp.where(jnp.abs(rise) > 1.5, rise, 0.0)
    return jnp.sum(rise * jnp.exp(-(across**2) - along**4), axis=0)


def _classes(key: jax.Array, kind: jax.Array) -> jax.Array:
    """`[16, 16]` class ids: Voronoi cells of one to all classes; soil in rectangles if mixed."""
    names = len(STANDARD.names)
    soils = names - FIRST_DEFORMABLE
    order_key, other_key = jax.random.split(key)
    order = jax.random.uniform(order_key, (names,))
    rigid_order = jnp.argsort(order[:FIRST_DEFORMABLE])
    soil_order = FIRST_DEFORMABLE + jnp.argsort(order[FIRST_DEFORMABLE:])
    drawn = jax.random.uniform(other_key, (2 + 2 * _VORONOI_CELLS + 4 * soils,))
    counts, centers, size, corner = jnp.split(
        drawn, [2, 2 + 2 * _VORONOI_CELLS, 2 + 2 * _VORONOI_CELLS + 2 * soils]
    )
    rigid_count, soil_count = 1 + (counts * jnp.array([FIRST_DEFORMABLE, soils])).astype(jnp.int32)

    centers = CELLS * centers.reshape(_VORONOI_CELLS, 2)
    i, j = jnp.mgrid[:CELLS, :CELLS]
    squared = (i[..., None] + 0.5 - centers[:, 0]) ** 2 + (j[..., None] + 0.5 - centers[:, 1]) ** 2
    cell = jnp.argmin(squared, axis=-1)
    rigid, soil = rigid_order[cell % rigid_count], soil_order[cell % soil_count]

    # Sides of 3 to 8 cells: one soil covers 3.5 % of the ground at least.
    size = 3 + (6 * size.reshape(soils, 2)).astype(jnp.int32)
    corner = (corner.reshape(soils, 2) * (CELLS + 1 - size)).astype(jnp.int32)
    mixed = rigid
    for k in range(soils):
        (top, left), (tall, wide) = corner[k], size[k]
        covered = (i >= top) & (i < top + tall) & (j >= left) & (j < left + wide)
        mixed = jnp.where(covered & (k < soil_count), soil_order[k], mixed)
    return jnp.stack([rigid, soil, mixed])[kind].astype(jnp.uint8)


def _friction(key: jax.Array, semantic: jax.Array) -> jax.Array:
    """A friction coefficient for each cell of rigid ground; 0 on soil."""
    mean = jnp.asarray(STANDARD.friction)[semantic]
    deviation = jnp.asarray(_FRICTION_DEVIATION)[semantic]
    drawn = mean + deviation * jax.random.normal(key, semantic.shape)
    return jnp.where(semantic < FIRST_DEFORMABLE, jnp.clip(drawn, *_FRICTION_LIMITS), 0.0)


@functools.partial(kept.jit, static_argnames=("rocks", "trees"))
def _obstacles(key: jax.Array, rocks: int, trees: int, obstructed: float) -> jax.Array:
    """`[rocks + trees, 5]` boxes anywhere on the map but near the circle of starts and goals.

    Zeros, which are no obstacles, in all but a share `obstructed` of worlds.
    """
    *_, key = jax.random.split(key, 4)
    drawn = jax.random.uniform(key, (rocks + trees, 4))
    scale = 0.7 + 0.5 * drawn[:rocks, :1]
    sizes = jnp.concatenate(
        [scale * jnp.array(ROCK_SIZE), jnp.broadcast_to(jnp.array(TREE_SIZE), (trees, 3))]
    )
    reach = jnp.linalg.norm(sizes[:, :2], axis=-1) / 2
    edge = HALF_EXTENT - reach[:, None]
    place = edge * (2 * drawn[:, 1:3] - 1)
    radius = jnp.linalg.norm(place, axis=-1)
    blocking = jnp.abs(radius - START_RADIUS) < START_CLEARANCE + reach
    # Those that would block the circle go inside it instead, in the same direction.
    inner = START_RADIUS - START_CLEARANCE - reach
    inner *= jnp.sqrt(drawn[:, 3])
    place *= jnp.where(blocking, inner / jnp.maximum(radius, 1e-6), 1.0)[:, None]
    some = jax.random.uniform(jax.random.fold_in(key, 0)) < obstructed
    return jnp.where(some, jnp.concatenate([place, sizes], axis=-1), 0.0)
