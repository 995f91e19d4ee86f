"""The terrain map of one world, or of many stacked worlds."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from numpy.typing import ArrayLike

from vertiwm_jax.errors import UserError
from vertiwm_jax.precision import float32
from vertiwm_jax.terrain import soil
from vertiwm_jax.terrain.classes import STANDARD, GroundClasses
from vertiwm_jax.terrain.ruts import Ruts
from vertiwm_jax.terrain.soil import Soil

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class MapError(UserError, ValueError):
    """A map cannot be used; the message names the file, the field and what to do."""

    def __init__(self, name: str, field: str, expected: str, found: str, mend: str = "") -> None:
        ending = f"; {mend}" if mend else ""
        found = textwrap.shorten(found, 300)  # Of arrays, not all, and in one line.
        super().__init__(f"{name}: {field}: expected {expected}, found {found}{ending}")


BY_WORLD = ("elevation", "semantic", "friction", "obstacles")
"""The arrays of a map of which each world has its own."""
MOST = 10**8
"""Numbers that an array of a map holds at most; checked before one is read."""
FAR = 1e3
"""Distance, m, of the middle of a map from x = y = 0 beyond which positions are counted from it:
within it, float32 resolves a tenth of a millimeter."""


@struct.dataclass
class ObservedMap:
    """What a vehicle knows of the selected world, and assumes of the rest; errors of its map.

    known: `[n, n]` bool, for cells that tile the map; row 0 is the northernmost.
    plane: `[3]` of unknown ground: its height at x = y = 0, m, and its slopes along x and y.
    semantic: `[]` int32 class id; friction: `[]` friction coefficient, both of unknown ground.
    displaced: `[2]` m, from where a place is to where the map has it.
    seed: `[]` uint32, of errors of the map; noise: `[]` m, standard deviation of errors of known
        heights, None for none.
    """

    known: jax.Array
    plane: jax.Array
    semantic: jax.Array
    friction: jax.Array
    displaced: jax.Array
    seed: jax.Array
    noise: jax.Array | None = None


@struct.dataclass
class TerrainMap:
    """W worlds of equal size, of which one is selected.

    Elevation lives on vertices: vertex (row r, column c) is x = origin_x + c resolution,
    y = origin_y - r resolution (row 0 at the largest y). Classes live on cells that tile the
    same extent: cell (i, j) of an `[r, c]` raster covers extent_x / c by extent_y / r meters.

    elevation: `[W, R, C]` m.
    semantic: `[W, r, c]` uint8 class ids.
    friction: `[W, r, c]` friction coefficient of rigid ground; 0 where the ground is soil.
    obstacles: `[W, N, 5]` center x, y, size x, size y, height above ground, m; unused rows are 0.
    origin: `[2]` world x, y of vertex (0, 0), m.
    resolution: `[]` m between vertices.
    class_rgb: `[K, 3]` uint8 palette.
    deformable: `[K]` bool, whether a class is soil.
    soils: leaves `[S, K]`, S is W or, where all worlds have the same, 1; read by `query.soil`,
        written by `with_soils`. Those of rigid classes are never used but finite.
    world: `[]` int32, the selected world.
    class_names: K names, static.
    grip: `[]` factor on all friction; None for 1.
    observed: what a vehicle knows of the selected world, which queries then answer from; None for
        all.
    ruts: of one vehicle in the selected world, which patches show; None for untouched ground.
    middles: x, y of the middle of each world in the coordinates of its file, m, static: positions
        are counted from there, see `offset`. Empty where they are as in the file.
    """

    elevation: jax.Array
    semantic: jax.Array
    friction: jax.Array
    obstacles: jax.Array
    origin: jax.Array
    resolution: jax.Array
    class_rgb: jax.Array
    deformable: jax.Array
    soils: Soil
    world: jax.Array
    class_names: tuple[str, ...] = struct.field(pytree_node=False)
    grip: jax.Array | None = None
    observed: ObservedMap | None = None
    ruts: Ruts | None = None
    middles: tuple[tuple[float, float], ...] = struct.field(pytree_node=False, default=())

    def offset(self, world: ArrayLike | None = None) -> np.ndarray:
        """x, y in the coordinates of the map's file of what is 0, 0 in those of this map, m.

        Maps of UTM coordinates are so large that float32 does not resolve them, so positions here
        are counted from the middle of such a world. Add this to the x, y of a position to have it
        in the file's coordinates, and subtract it from theirs, in float64.

        world: `[...]` numbers of worlds; the selected one by default.

        Returns:
            `[..., 2]` float64; 0 where both are the same.
        """
        chosen = np.asarray(self.world if world is None else world)
        return np.array(self.middles or [(0.0, 0.0)] * self.worlds)[chosen]

    @property
    def worlds(self) -> int:
        """How many worlds are stacked."""
        return self.elevation.shape[0]

    @property
    def size(self) -> jax.Array:
        """`[2]` m along x and along y."""
        rows, columns = self.elevation.shape[-2:]
        return self.resolution * jnp.array([columns - 1.0, rows - 1.0])

    def plot(self, names: Sequence[str] | None = None) -> "Figure":
        """The worlds from above, with a legend of their ground; a figure of matplotlib.

        names: of all worlds; their numbers by default.
        """
        from vertiwm_jax.terrain import picture

        return picture.plot(self, names)

    @property
    def extent(self) -> tuple[jax.Array, jax.Array]:
        """Lowest and highest x, y of the map, `[2]` m each."""
        along, up = self.size * jnp.eye(2)
        return self.origin - up, self.origin + along

    @staticmethod
    @float32
    def from_array(
        elevation: ArrayLike,
        classes: ArrayLike | str = "grass",
        *,
        resolution: float = 1.0,
        origin: ArrayLike | None = None,
        friction: ArrayLike | None = None,
        obstacles: ArrayLike | None = None,
        ground: GroundClasses = STANDARD,
        name: str = "map",
    ) -> "TerrainMap":
        """Makes a checked map of one world from arrays.

        Args:
            elevation: `[R, C]` heights of vertices, m; row 0 is the northernmost, column 0 the
                westernmost.
            classes: `[r, c]` class ids of cells over the same extent, or the name of one class.
            resolution: m between vertices.
            origin: x, y of vertex (0, 0), m, at any distance, in float64; the map is centered by
                default.
            friction: `[r, c]` coefficients; the mean of each class by default, ignored on soil.
            obstacles: `[N, 5]` center x, y, size x, size y and height, m; none by default.
                Their places are in the coordinates of `origin`.
            ground: the classes of ground that ids and names refer to.
            name: what errors call the map.

        Raises:
            MapError: an array is malformed; the message names it.
        """
        check, numbers = partial(_check, name), partial(_numbers, name)
        heights = numbers("elevation", elevation, np.float32)
        expected = "a 2-D array of 2 x 2 vertices or more"
        shape = heights.shape
        check("elevation", len(shape) == 2 and min(shape) >= 2, expected, f"shape {shape}")
        # In files, numbers such as -9999 stand for no height.
        good, expected = (heights > -1e3) & (heights < 1e4), "heights of -1 to 10 km"
        check("elevation", good, expected, heights, "fill the holes")
        check("resolution", 0 < resolution < np.inf, "meters between vertices, > 0", resolution)
        height, width = (resolution * (n - 1) for n in shape)
        centered = np.array([-width / 2, height / 2], np.float32)
        corner = numbers("origin", centered if origin is None else origin)
        # Coordinates on Earth are no larger.
        good = corner.shape == (2,) and (np.abs(corner) < 1e8).all()
        check("origin", good, "finite x, y in m", corner)

        if isinstance(classes, str):
            expected = f"one of {', '.join(ground.names)}"
            check("classes", classes in ground.names, expected, repr(classes))
            cells = shape if friction is None else np.shape(friction)
            classes = np.full(cells, ground.names.index(classes))
        semantic, last = np.asarray(classes), len(ground.names) - 1
        good, found = semantic.ndim == 2 and semantic.size > 0, f"shape {semantic.shape}"
        check("classes", good, "a 2-D array", found)
        integer = np.issubdtype(semantic.dtype, np.integer)
        check("classes", integer, "integer class ids", f"dtype {semantic.dtype}")
        expected = f"class ids 0 to {last} ({', '.join(ground.names)})"
        check("classes", (semantic >= 0) & (semantic <= last), expected, semantic)
        tall = height / width * semantic.shape[1] / semantic.shape[0]
        expected, mend = "square cells over the extent of the heights", "resample the classes"
        check("classes", 0.9 < tall < 1.1, expected, f"{tall:.2f} times as tall as wide", mend)
        colors = np.shape(ground.rgb)
        check("class_rgb", colors == (last + 1, 3), f"shape ({last + 1}, 3)", colors)
        check("class_rgb", (ground.rgb >= 0) & (ground.rgb <= 255), "0 to 255", ground.rgb)
        wrong = soil.out_of_range(ground.stacked_soils())
        check("soils", not wrong, "soils in SI units", wrong)

        if friction is None:
            friction = ground.friction[semantic]
        friction, soft = numbers("friction", friction, np.float32), ground.deformable[semantic]
        check("friction", friction.shape == soft.shape, f"shape {soft.shape}", friction.shape)
        good = soft | (friction > 0) & np.isfinite(friction)
        check("friction", good, "numbers > 0 on rigid ground", friction)
        boxes = numbers("obstacles", np.zeros((0, 5)) if obstacles is None else obstacles)
        check("obstacles", boxes.shape[1:] == (5,), "shape (any, 5)", boxes.shape)
        check("obstacles", np.isfinite(boxes), "finite numbers", boxes)
        good = (boxes[:, 2:] >= 0) & (boxes[:, 2:] < 1e4)
        check("obstacles", good, "sizes and heights >= 0, less than 10 km", boxes[:, 2:])
        low, high = corner - [0, height], corner + [width, 0]
        unused = ~boxes.any(axis=1, keepdims=True)
        good = unused | (boxes[:, :2] >= low) & (boxes[:, :2] <= high)
        expected = (
            f"centers within x {low[0]:.10g} to {high[0]:.10g}, y {low[1]:.10g} to {high[1]:.10g}"
        )
        check("obstacles", good, expected, boxes[:, :2])
        middle = corner - centered
        far = bool((np.abs(middle) > FAR).any())
        if far:
            corner, boxes = centered, np.where(unused, 0, boxes - [*middle, 0, 0, 0])

        return TerrainMap(
            elevation=jnp.asarray(heights[None]),
            semantic=jnp.asarray(semantic[None], jnp.uint8),
            friction=jnp.asarray(np.where(soft, 0, friction)[None], jnp.float32),
            obstacles=jnp.asarray(boxes[None], jnp.float32),
            origin=jnp.asarray(corner, jnp.float32),
            resolution=jnp.float32(resolution),
            class_rgb=jnp.asarray(ground.rgb, jnp.uint8),
            deformable=jnp.asarray(ground.deformable),
            soils=jax.tree.map(lambda leaf: leaf[None], ground.stacked_soils()),
            world=jnp.int32(0),
            class_names=ground.names,
            middles=(tuple(middle.tolist()),) if far else (),
        )

    def select(self, world: jax.Array) -> Self:
        """The map with world `[]` selected. Under `vmap` only the index is batched: no copy."""
        return replace(self, world=jnp.asarray(world, jnp.int32))

    def subset(self, worlds: np.ndarray) -> Self:
        """The map of some worlds alone, chosen by number or by bool; the first is selected."""
        changes = {name: getattr(self, name)[worlds] for name in BY_WORLD}
        if len(self.soils.n) > 1:
            changes["soils"] = jax.tree.map(lambda leaf: leaf[worlds], self.soils)
        if self.middles:
            numbers = np.arange(self.worlds)[worlds]
            changes["middles"] = tuple(self.middles[i] for i in numbers)
        return replace(self, **changes, world=jnp.int32(0))

    def with_soils(self, soils: Soil) -> Self:
        """The map with the same soils in all worlds: leaves `[K]`, or `[]` for all classes."""
        shape = (1, *self.deformable.shape)
        return replace(self, soils=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, shape), soils))


def stack(maps: Sequence[TerrainMap], names: Sequence[str] | None = None) -> TerrainMap:
    """Concatenates worlds of maps of equal extent, classes and scale; world 0 is selected.

    Soils may differ, and so may places of which positions are counted from the middle. Obstacle
    lists are padded to the longest. Raises `MapError` naming the first map that differs (by
    `names`, or its place) and the field.
    """
    if not maps:
        raise MapError("stack", "maps", "at least one map", "none")
    names = names or [f"map {i}" for i in range(len(maps))]
    first, *others = map(_shared, maps)
    for other, name in zip(others, names[1:], strict=True):
        for field, ours in first.items():
            alike = np.array_equal if isinstance(ours, tuple) else np.allclose
            if not alike(ours, other[field]):
                raise MapError(name, field, f"{ours} as in {names[0]}", f"{other[field]}")
    longest = max(m.obstacles.shape[1] for m in maps)

    def of_all(name: str) -> jax.Array:
        arrays = [getattr(m, name) for m in maps]
        if name == "obstacles":
            arrays = [jnp.pad(x, ((0, 0), (0, longest - x.shape[1]), (0, 0))) for x in arrays]
        return jnp.concatenate(arrays)

    soils = jax.tree.map(lambda *x: jnp.concatenate(x), *map(_soils_by_world, maps))
    if all(np.allclose(x, x[:1]) for x in jax.tree.leaves(soils)):
        soils = jax.tree.map(lambda x: x[:1], soils)
    stacked: dict[str, Any] = {name: of_all(name) for name in BY_WORLD}
    if any(m.middles for m in maps):
        offsets = np.concatenate([m.offset(np.arange(m.worlds)) for m in maps])
        stacked["middles"] = tuple(map(tuple, offsets.tolist()))
    return replace(maps[0], **stacked, soils=soils, world=jnp.int32(0))


def _shared(terrain: TerrainMap) -> dict[str, Any]:
    """What stacked worlds have in common; of arrays over the ground their shapes."""
    arrays = ("origin", "resolution", "class_rgb", "deformable")
    return {
        "class_names": terrain.class_names,
        "elevation": terrain.elevation.shape[1:],
        "semantic": terrain.semantic.shape[1:],
        **{name: np.asarray(getattr(terrain, name)).tolist() for name in arrays},
    }


def _soils_by_world(terrain: TerrainMap) -> Soil:
    """Leaves `[W, K]`, also where all worlds share them."""
    shape = (terrain.worlds, len(terrain.class_names))
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, shape), terrain.soils)


def expect_room(terrain: TerrainMap, least: float, name: str) -> None:
    """Raises `MapError` unless each side of the map is `least` m long."""
    width, height = terrain.size.tolist()
    if min(width, height) < least:
        expected = f"at least {least:g} m x {least:g} m, to hold starts and goals"
        found = f"{width:g} m x {height:g} m"
        raise MapError(name, "size", expected, found, "make a larger map")


def bounded(name: str, field: str, shape: Sequence[int]) -> None:
    """Raises `MapError` where an array of this shape would be too large to be read."""
    if math.prod(shape) > MOST:
        found = " x ".join(map(str, shape))
        raise MapError(name, field, f"at most {MOST:,} numbers", found, "cut the map to a part")


def _numbers(
    name: str, field: str, values: ArrayLike, dtype: type[np.floating] = np.float64
) -> np.ndarray:
    """The values as floats, those that are too large as inf; `MapError` unless all are numbers."""
    try:
        found = np.asarray(values)
    except ValueError as error:  # Lists of unequal length.
        raise MapError(name, field, "an array", f"{error}") from None
    if found.dtype.kind not in "biuf":
        raise MapError(name, field, "numbers", f"dtype {found.dtype}")
    with np.errstate(over="ignore"):
        return found.astype(dtype)


def _check(
    name: str, field: str, good: ArrayLike, expected: str, found: Any, mend: str = ""
) -> None:
    """Raises `MapError` unless all is good; of an array it tells the first value that is not."""
    bad = np.argwhere(np.logical_not(good))
    if len(bad):
        if bad.size:
            row, column = bad[0]
            found = f"{found[row, column]} at row {row}, column {column} ({len(bad)} such)"
        raise MapError(name, field, expected, f"{found}", mend)
