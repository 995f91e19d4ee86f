"""The terrain map of one world, or of many stacked worlds."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from numpy.typing import ArrayLike

from vertiwm_jax.errors import UserError
from vertiwm_jax.terrain import soil
from vertiwm_jax.terrain.classes import STANDARD, GroundClasses
from vertiwm_jax.terrain.soil import Soil

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# What stacked worlds have in common.
_SHARED = ("origin", "resolution", "class_rgb", "deformable")


class MapError(UserError, ValueError):
    """A map cannot be used; the message names the file, the field and what to do."""

    def __init__(self, name: str, field: str, expected: str, found: str, mend: str = "") -> None:
        ending = f"; {mend}" if mend else ""
        super().__init__(f"{name}: {field}: expected {expected}, found {found}{ending}")


@struct.dataclass
class ObservedMap:
    """The cells of the selected world that a vehicle knows, and its assumption about the rest.

    known: `[n, n]` bool, for cells that tile the map; row 0 is the northernmost.
    plane: `[3]` of unknown ground: its height at x = y = 0, m, and its slopes along x and y.
    semantic: `[]` int32 class id; friction: `[]` friction coefficient, both of unknown ground.
    """

    known: jax.Array
    plane: jax.Array
    semantic: jax.Array
    friction: jax.Array


@struct.dataclass
class TerrainMap:
    """W worlds of equal size, of which one is selected.

    Elevation lives on vertices: vertex (row r, column c) is x = origin_x + c resolution,
    y = origin_y - r resolution (row 0 at the largest y). Classes live on cells that tile the
    same extent: cell (i, j) of an `[r, c]` raster covers extent_x / c by extent_y / r metres.

    elevation: `[W, R, C]` m.
    semantic: `[W, r, c]` uint8 class ids.
    friction: `[W, r, c]` friction coefficient of rigid ground; 0 where the ground is soil.
    obstacles: `[W, N, 5]` centre x, y, size x, size y, height above ground, m; unused rows are 0.
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

    @property
    def soil_set(self) -> jax.Array | int:
        """Which of the sets of soils the selected world has."""
        return self.world if len(self.soils.n) > 1 else 0

    @staticmethod
    def from_array(
        elevation: ArrayLike,
        classes: ArrayLike | str = "grass",
        *,
        resolution: float = 1.0,
        origin: tuple[float, float] | None = None,
        friction: ArrayLike | None = None,
        obstacles: ArrayLike | None = None,
        name: str = "map",
    ) -> "TerrainMap":
        """Makes a checked map of one world from arrays.

        Args:
            elevation: `[R, C]` heights of vertices, m; row 0 is the northernmost, column 0 the
                westernmost.
            classes: the name of a class of ground (`terrain.classes.STANDARD`), or `[r, c]` ids
                of cells over the same extent.
            resolution: m between vertices.
            origin: x, y of vertex (0, 0), m; the map is centred by default.
            friction: `[r, c]` coefficients; the mean of each class by default, ignored on soil.
            obstacles: `[N, 5]` centre x, y, size x, size y and height, m; none by default.
            name: what errors call the map.

        Raises:
            MapError: an array is malformed; the message names it.
        """
        if isinstance(classes, str):
            if classes not in STANDARD.names:
                expected = f"one of {', '.join(STANDARD.names)}"
                raise MapError(name, "classes", expected, repr(classes))
            cells = np.shape(elevation if friction is None else friction)
            classes = np.full(cells, STANDARD.names.index(classes))
        return build(
            elevation,
            classes,
            friction,
            obstacles,
            resolution=resolution,
            origin=origin,
            name=name,
        )

    def select(self, world: jax.Array) -> Self:
        """The map with world `[]` selected. Under `vmap` only the index is batched: no copy."""
        return replace(self, world=jnp.asarray(world, jnp.int32))

    def subset(self, worlds: np.ndarray) -> Self:
        """The map of some worlds alone, chosen by number or by bool; the first is selected."""
        names = ("elevation", "semantic", "friction", "obstacles")
        changes = {name: getattr(self, name)[worlds] for name in names}
        if len(self.soils.n) > 1:
            changes["soils"] = jax.tree.map(lambda leaf: leaf[worlds], self.soils)
        return replace(self, **changes, world=jnp.int32(0))

    def with_soils(self, soils: Soil) -> Self:
        """The map with the same soils in all worlds: leaves `[K]`, or `[]` for all classes."""
        shape = (1, *self.deformable.shape)
        return replace(self, soils=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, shape), soils))


def build(
    elevation: ArrayLike,
    semantic: ArrayLike,
    friction: ArrayLike | None = None,
    obstacles: ArrayLike | None = None,
    *,
    resolution: float = 1.0,
    origin: tuple[float, float] | None = None,
    classes: GroundClasses = STANDARD,
    name: str = "map",
) -> TerrainMap:
    """A checked map of one world, from arrays.

    elevation `[R, C]` m, semantic `[r, c]` class ids, friction `[r, c]` (the mean of each class
    when left out; values on soil are ignored), obstacles `[N, 5]`, resolution m, origin x, y of
    vertex (0, 0) m (the map is centred when left out). Raises `MapError`, which calls it `name`.
    """
    elevation, semantic = np.asarray(elevation, np.float32), np.asarray(semantic)
    for field, array in (("elevation", elevation), ("semantic", semantic)):
        if array.ndim != 2:
            raise MapError(name, field, "a 2-D array", f"shape {array.shape}")
    _check_ids(semantic, classes.names, name)
    if friction is None:
        friction = classes.friction[semantic]
    friction = np.asarray(friction, np.float32)
    if friction.shape == semantic.shape:
        friction = np.where(classes.deformable[semantic], 0, friction)
    if origin is None:
        rows, columns = elevation.shape
        origin = (-(columns - 1) / 2 * resolution, (rows - 1) / 2 * resolution)
    obstacles = np.zeros((0, 5)) if obstacles is None else np.asarray(obstacles)
    terrain = TerrainMap(
        elevation=jnp.asarray(elevation[None]),
        semantic=jnp.asarray(semantic[None], jnp.uint8),
        friction=jnp.asarray(friction[None], jnp.float32),
        obstacles=jnp.asarray(obstacles[None], jnp.float32),
        origin=jnp.asarray(origin, jnp.float32),
        resolution=jnp.float32(resolution),
        class_rgb=jnp.asarray(classes.rgb, jnp.uint8),
        deformable=jnp.asarray(classes.deformable),
        soils=jax.tree.map(lambda leaf: leaf[None], classes.stacked_soils()),
        world=jnp.int32(0),
        class_names=classes.names,
    )
    return validate(terrain, name)


def stack(maps: Sequence[TerrainMap], names: Sequence[str] | None = None) -> TerrainMap:
    """Concatenates worlds of maps of equal extent, classes and scale; world 0 is selected.

    Soils may differ. Obstacle lists are padded to the longest. Raises `MapError` naming the first
    map that differs (by `names`, or its place) and the field.
    """
    if not maps:
        raise MapError("stack", "maps", "at least one map", "none")
    names = names or [f"map {i}" for i in range(len(maps))]
    first = maps[0]
    for terrain, name in zip(maps[1:], names[1:], strict=True):
        for field in ("elevation", "semantic"):
            ours, theirs = (getattr(m, field).shape[1:] for m in (first, terrain))
            if ours != theirs:
                expected = f"shape {ours} as in {names[0]}"
                raise MapError(name, field, expected, f"{theirs}", "crop or resample it")
        ours, theirs = first.class_names, terrain.class_names
        if ours != theirs:
            raise MapError(name, "class_names", f"{ours} as in {names[0]}", f"{theirs}")
        for field in _SHARED:
            ours, theirs = (jax.tree.leaves(getattr(m, field)) for m in (first, terrain))
            if not all(np.allclose(a, b) for a, b in zip(ours, theirs, strict=True)):
                ours, theirs = (np.array_str(np.asarray(x).squeeze()) for x in (ours, theirs))
                raise MapError(name, field, f"{ours} as in {names[0]}", theirs)
    longest = max(m.obstacles.shape[1] for m in maps)

    def padded(terrain: TerrainMap) -> jax.Array:
        missing = longest - terrain.obstacles.shape[1]
        return jnp.pad(terrain.obstacles, ((0, 0), (0, missing), (0, 0)))

    return replace(
        first,
        elevation=jnp.concatenate([m.elevation for m in maps]),
        semantic=jnp.concatenate([m.semantic for m in maps]),
        friction=jnp.concatenate([m.friction for m in maps]),
        obstacles=jnp.concatenate([padded(m) for m in maps]),
        soils=_stacked_soils(maps),
        world=jnp.int32(0),
    )


def _stacked_soils(maps: Sequence[TerrainMap]) -> Soil:
    """Those of all maps, one set if they have the same."""
    first, *others = [m.soils for m in maps]
    if len(first.n) == 1 and all(_alike(first, soils) for soils in others):
        return first
    worlds = [m.select(jnp.int32(i)) for m in maps for i in range(m.worlds)]
    return soil.stack([jax.tree.map(lambda x, i=m.soil_set: x[i], m.soils) for m in worlds])


def _alike(ours: Soil, theirs: Soil) -> bool:
    pairs = zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True)
    return all(a.shape == b.shape and np.allclose(a, b) for a, b in pairs)


def validate(terrain: TerrainMap, name: str = "map") -> TerrainMap:
    """The same map if it can be used; `MapError` names `name`, the field and the place.

    For concrete maps at the border (files, user arrays), not inside jit.
    """
    worlds, classes = terrain.elevation.shape[0], len(terrain.class_names)
    _check_shapes(terrain, worlds, classes, name)
    resolution, origin = np.asarray(terrain.resolution), np.asarray(terrain.origin)
    if not (np.isfinite(resolution) and resolution > 0):
        raise MapError(name, "resolution", "metres between vertices, > 0", f"{resolution}")
    # Farther away, float32 does not tell centimetres apart.
    if not (np.abs(origin) < 1e5).all():
        expected, mend = "finite x, y, less than 100 km", "count them from a point on the map"
        raise MapError(name, "origin", expected, f"{origin}", mend)
    if not 0 <= int(terrain.world) < worlds:
        raise MapError(name, "world", f"0 to {worlds - 1}", f"{int(terrain.world)}")

    elevation = np.asarray(terrain.elevation)
    # Of files, numbers such as -9999 stand for no height.
    found, expected = (elevation > -1e3) & (elevation < 1e4), "heights of -1 to 10 km"
    _check(found, elevation, name, "elevation", expected, "fill the holes")

    semantic, friction = np.asarray(terrain.semantic), np.asarray(terrain.friction)
    _check_ids(semantic, terrain.class_names, name)
    rows, columns = (n - 1 for n in elevation.shape[1:])
    aspect = (rows / semantic.shape[1]) / (columns / semantic.shape[2])
    if not 0.9 < aspect < 1.1:
        raise MapError(
            name, "semantic", f"square cells over {rows} x {columns} vertex cells",
            f"{semantic.shape[1]} x {semantic.shape[2]} cells, {aspect:.2f} times as tall as wide",
            "resample the class raster to the extent of the heights",
        )  # fmt: skip
    soft = np.asarray(terrain.deformable)[semantic]
    _check(np.isfinite(friction) & (friction >= 0), friction, name, "friction", "numbers >= 0")
    _check(soft | (friction > 0), friction, name, "friction", "> 0 on rigid ground")
    _check(~soft | (friction == 0), friction, name, "friction", "0 on soil")
    try:
        soil.validate(terrain.soils, f"{name}: soils")
    except ValueError as error:
        raise MapError(name, "soils", "soils in SI units", str(error)) from None
    _check_obstacles(terrain, name)
    return terrain


def _check(
    good: np.ndarray, values: np.ndarray, name: str, field: str, expected: str, mend: str = ""
) -> None:
    """Raises with the first of the values that are not good, where it is and how many there are."""
    bad = np.argwhere(~good)
    if len(bad):
        world, row, column = bad[0]
        where = f"{values[world, row, column]} at world {world}, row {row}, column {column}"
        raise MapError(name, field, expected, f"{where} ({len(bad)} such)", mend)


def _check_ids(semantic: np.ndarray, class_names: tuple[str, ...], name: str) -> None:
    if not np.issubdtype(semantic.dtype, np.integer):
        raise MapError(name, "semantic", "integer class ids", f"dtype {semantic.dtype}")
    last = len(class_names) - 1
    stacked = semantic if semantic.ndim == 3 else semantic[None]
    expected = f"class ids 0 to {last} ({', '.join(class_names)})"
    _check((stacked >= 0) & (stacked <= last), stacked, name, "semantic", expected)


def _check_shapes(terrain: TerrainMap, worlds: int, classes: int, name: str) -> None:
    expected: dict[str, tuple[int | None, ...]] = {
        "elevation": (worlds, None, None),
        "semantic": (worlds, None, None),
        "friction": terrain.semantic.shape,
        "obstacles": (worlds, None, 5),
        "origin": (2,),
        "resolution": (),
        "class_rgb": (classes, 3),
        "deformable": (classes,),
        "world": (),
    }
    leaves = {field: getattr(terrain, field) for field in expected}
    for field, value in vars(terrain.soils).items():
        sets = worlds if jnp.shape(value)[:1] == (worlds,) else 1
        expected[f"soils.{field}"], leaves[f"soils.{field}"] = (sets, classes), value
    for field, shape in expected.items():
        found = jnp.shape(leaves[field])
        agrees = len(found) == len(shape) and all(
            n in (None, m) for n, m in zip(shape, found, strict=True)
        )
        if not agrees:
            wanted = ", ".join("any" if n is None else str(n) for n in shape)
            mend = f"there are {worlds} worlds and {classes} classes"
            raise MapError(name, field, f"shape ({wanted})", f"{found}", mend)
    if min(terrain.elevation.shape[1:]) < 2 or min(terrain.semantic.shape[1:]) < 1:
        found = f"{terrain.elevation.shape[1:]} and {terrain.semantic.shape[1:]}"
        raise MapError(name, "elevation", "2 x 2 vertices and 1 cell or more", found)


def _check_obstacles(terrain: TerrainMap, name: str) -> None:
    obstacles = np.asarray(terrain.obstacles)
    columns = ("x", "y", "size x", "size y", "height")
    expected = "finite numbers in columns " + ", ".join(columns)
    _check(np.isfinite(obstacles), obstacles, name, "obstacles", expected)
    sizes = np.broadcast_to(obstacles[..., 2:].min(-1, keepdims=True), obstacles.shape)
    _check(sizes >= 0, obstacles, name, "obstacles", "sizes and heights >= 0")
    low, high = map(np.asarray, terrain.extent)
    centre = obstacles[..., :2]
    unused = (obstacles == 0).all(-1, keepdims=True)
    inside = unused | ((centre >= low) & (centre <= high))
    expected = f"centres within x {low[0]:g} to {high[0]:g}, y {low[1]:g} to {high[1]:g}"
    _check(inside, centre, name, "obstacles", expected)
