"""Collections of recorded drives in memory, and what each drive is for.

The format of the files is that of `vertiwm_jax.learning.schema`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax import geometry
from vertiwm_jax.config import Share, settings
from vertiwm_jax.learning import schema
from vertiwm_jax.learning.schema import SPLITS, DataError
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.measured import is_described, measured
from vertiwm_jax.mechanics.vehicle import Vehicle, VehicleConfig
from vertiwm_jax.precision import float32
from vertiwm_jax.state import Turn
from vertiwm_jax.terrain import files, query
from vertiwm_jax.terrain.map import TerrainMap, stack

Split = Literal["train", "validation", "test", "unseen", "all"]
"""Which drives: those for one purpose, all of the worlds that are left out, or all."""
UNSEEN = (
    "open/rigid/rigid_012",
    "open/rigid/rigid_016",
    "open/rigid/rigid_014",
    "open/rigid/rigid_013",
    "open/deformable/deformable_013",
    "open/deformable/deformable_015",
    "open/deformable/deformable_016",
    "open/deformable/deformable_010",
    "open/mixed/mixed_016",
    "open/mixed/mixed_014",
    "open/mixed/mixed_015",
    "open/mixed/mixed_002",
    "vehicles/fam_006_*",
    "vehicles/fam_009_*",
    "vehicles/uaz_*",
)
"""What no fit learns from: of each kind of worlds of `data/open` the last with low relief, the last
that is rolling, the last in between and the last with high relief; and three vehicles."""
_IN_A_ROW = 25
"""So neighbors, maybe pieces of one log, are mostly for the same; yet tests are from all of it."""

Array = np.ndarray | jax.Array


@struct.dataclass
class WheelSignals:
    """Signals of wheels and chassis, None where missing. Wheels are FL, FR, RL, RR.

    wheel_omega: `[..., 4]` rad/s, positive forward.
    wheel_sinkage: `[..., 4]` m below the undeformed ground; negative in the air.
    wheel_force: `[..., 4, 3]` N, ground on wheel, world frame, mean over the last step.
    chassis_force: `[..., 3]` N, ground on belly, the same.
    steer_angle: `[..., 2]` rad, front-left and front-right wheel.
    """

    wheel_omega: Array | None = None
    wheel_sinkage: Array | None = None
    wheel_force: Array | None = None
    chassis_force: Array | None = None
    steer_angle: Array | None = None


@struct.dataclass
class Drives:
    """D drives of at most T steps: in host memory once loaded, `jax.device_put` moves them.

    state: `[D, T + 1, 12]` float32; control: `[D, T, 2]` float32; length: `[D]` valid steps, later
    values have no meaning; wheel_class: `[D, T + 1, 4]` uint8; world: `[D]` index into
    the terrain map; wheels: leaves `[D, T + 1, ...]` float32; vehicles: by world, the name of the
    vehicle that drove there, static; described: by world, that vehicle where its file describes it,
    static; turn: what the second of the commands is, static.
    """

    state: Array
    control: Array
    length: Array
    wheel_class: Array
    world: Array
    wheels: WheelSignals
    vehicles: tuple[str, ...] = struct.field(default=(), pytree_node=False)
    described: tuple[VehicleConfig | None, ...] = struct.field(default=(), pytree_node=False)
    turn: Turn = struct.field(default="steering", pytree_node=False)

    def driven(self, otherwise: Vehicle) -> Vehicle:
        """The vehicles that drove, leaves `[W, ...]`, to `select` by world.

        otherwise: where a file describes none.

        Raises `DataError` unless they are steered as the drives were.
        """
        every = [own.vehicle if own else otherwise for own in self.described]
        for each in every:
            self.expect_steered_by(each)
        return vehicle.stack(every)

    def expect_steered_by(self, driven: Vehicle | VehicleConfig) -> None:
        """Raises `DataError` unless a vehicle takes such commands as the drives have."""
        if driven.turn != self.turn:
            kinds = {"steering": "with front wheels that steer", "yaw_rate": "skid-steered"}
            raise DataError(
                f"vehicle: expected one {kinds[self.turn]}, as commands of the drives have a "
                f"{self.turn.replace('_', ' ')}, found one {kinds[driven.turn]}; `--vehicle` names "
                "another"
            )


@settings
class SplitConfig:
    """How drives are shared out where their files do not say what each drive is for."""

    shares: tuple[Share, Share, Share] = (0.8, 0.08, 0.12)
    """Of drives to train, for validation and to test, of all files of a folder together."""
    whole: Literal["drives", "worlds"] = "drives"
    """What is never divided: drives, or all drives on the same map."""
    leave_out: tuple[str, ...] = ()
    """Worlds of which no drive is to train or for validation, whatever files say: ends of the paths
    of their files, without `.npz`; `vehicles/uaz_*` are all that begin so."""

    def check(self):
        if abs(sum(self.shares) - 1) > 1e-6:
            raise ValueError(f"shares: expected a sum of 1, found {sum(self.shares):g}")

    def of(self, count: int) -> np.ndarray | None:
        """`[count]` what each of so many drives or worlds is for; None where they are too few.

        Each purpose that has a share gets one at least. They are spread evenly, and of each 25 in a
        row the first are to train and the last to test.
        """
        shares = np.array(self.shares)
        quotas = (shares > 0).astype(int)
        if quotas.sum() > count:
            return None
        for _ in range(count - quotas.sum()):
            quotas[np.argmax(shares * count - quotas)] += 1
        order, given = np.zeros(count, int), np.zeros(3, int)
        for place in range(count):
            order[place] = np.argmax(quotas * (place + 1) - given * count)
            given[order[place]] += 1
        for first in range(0, count, _IN_A_ROW):
            order[first : first + _IN_A_ROW].sort()
        return np.array(SPLITS)[order]


FITTED = SplitConfig(leave_out=UNSEEN)
"""How drives are shared out for fits, and for tests of what was fitted."""


@dataclass(frozen=True)
class Collection:
    """A folder of drives: how long they are, and what each is for.

    lengths, purposes: `[K]` by file. decided: by what. divided: False where the drives are too few
    to share out; then all are to train. left_out: by file, the name by which it is left out.
    """

    folder: Path
    lengths: dict[Path, np.ndarray]
    purposes: dict[Path, np.ndarray]
    decided: str
    divided: bool
    left_out: dict[Path, str]

    @classmethod
    def of(cls, folder: str | Path, splits: SplitConfig = SplitConfig()) -> Self:
        """Of all `.npz` files in a folder; raises `DataError`."""
        found = {path: schema.outline(path) for path in sorted(Path(folder).glob("*.npz"))}
        if not found:
            raise DataError(f"{folder}: expected a folder with .npz files of drives, found none")
        lengths = {path: length for path, (length, _, _) in found.items()}
        said = {path: split for path, (_, split, _) in found.items() if split is not None}
        by_world = splits.whole == "worlds"
        units = {
            path: [ground if by_world else (path, drive) for drive in range(len(length))]
            for path, (length, _, ground) in found.items()
            if path not in said
        }
        every = list(dict.fromkeys(unit for own in units.values() for unit in own))
        shared = splits.of(len(every))
        divided = shared is not None or not units
        purpose = dict(
            zip(every, ["train"] * len(every) if shared is None else shared, strict=True)
        )
        given = {path: np.array([purpose[unit] for unit in own]) for path, own in units.items()}
        decided = ["as files say"] if said else []
        if units:
            decided.append(f"by share of {splits.whole}" if divided else "too few to share out")
        named = ((path, name) for path in found for name in splits.leave_out if _ends(path, name))
        left_out, purposes = dict(named), said | given
        for path in left_out:
            purposes[path] = np.where(purposes[path] == "test", "test", "unseen")
        return cls(Path(folder), lengths, purposes, ", ".join(decided), divided, left_out)

    def rows(self, path: Path, split: Split) -> np.ndarray:
        """Which drives of a file are of a split."""
        every = split == "all" or (split == "unseen" and path in self.left_out)
        return np.flatnonzero((self.purposes[path] == split) | every)

    def longest(self, split: Split) -> int:
        """Steps of the longest drive of a split; -1 if it has none."""
        found = [length[self.rows(path, split)] for path, length in self.lengths.items()]
        return int(np.concatenate(found).max(initial=-1))

    def __str__(self) -> str:
        every = np.concatenate(list(self.purposes.values())).tolist()
        told = (*SPLITS, "unseen") if self.left_out else SPLITS
        counts = ", ".join(f"{every.count(purpose)} {purpose}" for purpose in told)
        return f"{self.folder}: {len(every)} drives: {counts} ({self.decided})"


def _ends(path: Path, name: str) -> bool:
    """Whether the path of a file of drives ends with a name or pattern, which has no `.npz`."""
    return bool(name) and path.resolve().with_suffix("").match(name)


def expect_drives(collections: Sequence[Collection], split: Split, steps: int = 0) -> None:
    """Raises `DataError` unless each has a drive of the split, and one of them so many steps."""
    if not collections:
        raise DataError("drives: expected a folder of drives or more, found none")
    for collection in collections:
        if collection.longest(split) < 0:
            raise DataError(
                f"{collection}: expected drives of the {split} split, found none; record more, or "
                "import them in shorter pieces (resampling.longest); evaluate takes all by "
                "`--split all`"
            )
    of = max(collections, key=lambda collection: collection.longest(split))
    if of.longest(split) < steps:
        raise DataError(
            f"{of}: expected a drive of at least {steps} steps in the {split} split, found at most "
            f"{of.longest(split)}; record longer ones, or ask for less context or horizon"
        )


@float32
def load_drives(
    folders: str | Path | Sequence[str | Path],
    split: Split = "train",
    splits: SplitConfig = SplitConfig(),
    *,
    wheels: bool = True,
) -> tuple[Drives, TerrainMap]:
    """Loads recorded drives, and the maps that they were driven on.

    Args:
        folders: a folder of `.npz` files of drives, or several.
        split: which drives of each folder: those to `train`, for `validation` or to `test`; all of
            the worlds that are left out, `unseen`; or `all`.
        splits: how the drives of a folder are shared out whose files do not say it, and which
            worlds are left out.
        wheels: whether to load signals of wheels and chassis too, which all files have or none.

    Returns:
        D drives at 10 Hz, of T steps at most: states `[D, T + 1, 12]` (position in m and roll,
        pitch, yaw in rad in the frame of the world, velocity and angular velocity in that of the
        body), commands `[D, T, 2]` (m/s, rad). And W worlds, of which `world` `[D]` is driven on.

    Raises:
        DataError: a file is malformed, or a folder has too few drives for this split.
        MapError: a map is missing, malformed, or differs from the others in extent or classes.
    """
    paths: list[Path] = []
    parts: list[dict[str, np.ndarray]] = []
    maps: list[TerrainMap] = []
    facts: list[dict[str, Any]] = []
    given = [folders] if isinstance(folders, str | Path) else folders
    collections = [Collection.of(folder, splits) for folder in given]
    expect_drives(collections, split)
    for collection in collections:
        for path in collection.lengths:
            rows = collection.rows(path, split)
            if not len(rows):
                continue
            arrays, terrain, said = _read(path)
            wanted = arrays.keys() if wheels else arrays.keys() - set(schema.WHEEL_SIGNALS)
            picked = {name: arrays[name][rows] for name in wanted}
            parts.append({**picked, "world": np.full(len(rows), len(maps), np.int32)})
            maps.append(terrain)
            paths.append(path)
            facts.append(said)
    return _join(paths, facts, parts), stack(maps, [f"map of {path}" for path in paths])


def load_file(path: Path) -> tuple[Drives, TerrainMap]:
    """All drives of one file, with its map; raises like `load_drives`."""
    arrays, terrain, said = _read(path)
    world = np.zeros(len(arrays["length"]), np.int32)
    return _join([path], [said], [{**arrays, "world": world}]), terrain


def _read(path: Path) -> tuple[dict[str, np.ndarray], TerrainMap, dict[str, Any]]:
    """The arrays of all drives of a file, without what they are for, its map, and what it says of
    its vehicle."""
    arrays, meta = schema.read(path)
    arrays.pop("split", None)
    terrain = files.load_map(schema.find_map(path, meta["map"]))
    said = schema.vehicle_facts(meta)
    arrays = schema.check(path, arrays, terrain.offset(), schema.turn_of(path, said))
    _check_place(path, arrays, terrain)
    if "wheel_class" not in arrays:
        wheels = np.asarray(meta["vehicle"]["wheels_in_body_xy"], np.float32)
        arrays["wheel_class"] = _look_up_classes(terrain, arrays["state"], wheels)
    schema.check_classes(path, arrays["wheel_class"], len(terrain.class_names))
    kinds = {"length": np.int32, "wheel_class": np.uint8}
    arrays |= {name: arrays[name].astype(kind) for name, kind in kinds.items()}
    return arrays, terrain, said


def _check_place(path: Path, arrays: dict[str, np.ndarray], terrain: TerrainMap) -> None:
    """Raises `DataError` where all positions are off the map: their coordinates are others."""
    steps = np.arange(arrays["state"].shape[1])
    xy = arrays["state"][steps <= arrays["length"][:, None], :2]
    low, high = map(np.asarray, terrain.extent)
    if not ((xy >= low) & (xy <= high)).all(axis=1).any():
        offset = terrain.offset()
        (west, south), (east, north) = low + offset, high + offset
        x, y = xy[0] + offset
        raise DataError(
            f"{path}: state: expected positions on its map, x from {west:.10g} to {east:.10g} m "
            f"and y from {south:.10g} to {north:.10g} m, found none, the first is "
            f"({x:.10g}, {y:.10g})"
        )


def _look_up_classes(terrain: TerrainMap, state: np.ndarray, wheels: np.ndarray) -> np.ndarray:
    """`[K, T + 1, 12]` and wheels `[4, 2]` in the body to the `[K, T + 1, 4]` classes below."""
    rotation = geometry.rotation_from_rpy(jnp.asarray(state[..., 3:6], jnp.float32)).as_matrix()
    xy = state[..., None, :2] + jnp.einsum("...ij,wj->...wi", rotation[..., :2, :2], wheels)
    return np.asarray(query.surface(terrain, jnp.asarray(xy)).semantic)


def _join(
    paths: list[Path], facts: list[dict[str, Any]], parts: list[dict[str, np.ndarray]]
) -> Drives:
    """All parts one after the other, padded to the longest drive; facts: of their vehicles."""
    every = set().union(*parts)
    for name in sorted(every):
        lacking = [path for path, part in zip(paths, parts, strict=True) if name not in part]
        if lacking:
            raise DataError(
                f"{lacking[0]}: {name}: expected in all files that are loaded together or in "
                f"none, missing in {len(lacking)} of {len(paths)}"
            )
    joined = schema.join(parts)
    signals = WheelSignals(
        **{name: joined.pop(name) for name in schema.WHEEL_SIGNALS if name in joined}
    )
    described = (
        measured(own, f"{path}: meta.vehicle") if is_described(own) else None
        for path, own in zip(paths, facts, strict=True)
    )
    turns: list[Turn] = [schema.turn_of(path, own) for path, own in zip(paths, facts, strict=True)]
    for path, turn in zip(paths, turns, strict=True):
        if turn != turns[0]:
            raise DataError(
                f"{path}: meta: expected vehicle.turn {turns[0]}, as in {paths[0]}, found {turn}"
            )
    return Drives(
        **joined,
        turn=turns[0],
        wheels=signals,
        vehicles=tuple(map(schema.vehicle_name, facts)),
        described=tuple(described),
    )
