"""Collections of recorded drives in memory: splits by drive and by world.

The format of the files is that of `vertiwm_jax.learning.schema`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax import geometry
from vertiwm_jax.learning import schema
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.precision import float32
from vertiwm_jax.terrain import files, query
from vertiwm_jax.terrain.map import TerrainMap, stack

Split = Literal["train", "validation", "test"]
SPLITS: dict[Split, range] = {
    "train": range(20),
    "validation": range(20, 22),
    "test": range(22, 25),
}
"""Indices of the drives of each file in each split."""

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
    vehicle that drove there, static.
    """

    state: Array
    control: Array
    length: Array
    wheel_class: Array
    world: Array
    wheels: WheelSignals
    vehicles: tuple[str, ...] = struct.field(default=(), pytree_node=False)


@float32
def load_drives(
    folders: str | Path | Sequence[str | Path], split: Split = "train"
) -> tuple[Drives, TerrainMap]:
    """Loads recorded drives, and the maps that they were driven on.

    Args:
        folders: a folder of `.npz` files of drives, or several.
        split: which drives of each file: `train`, `validation` or `test`.

    Returns:
        D drives at 10 Hz, of T steps at most: states `[D, T + 1, 12]` (position in m and roll,
        pitch, yaw in rad in the frame of the world, velocity and angular velocity in that of the
        body), commands `[D, T, 2]` (m/s, rad). And W worlds, of which `world` `[D]` is driven on.

    Raises:
        DataError: a file is malformed, or has too few drives for this split.
        MapError: a map is missing, malformed, or differs from the others in extent or classes.
    """
    paths: list[Path] = []
    parts: list[dict[str, np.ndarray]] = []
    maps: list[TerrainMap] = []
    for folder in [folders] if isinstance(folders, str | Path) else folders:
        found = sorted(Path(folder).glob("*.npz"))
        if not found:
            raise DataError(f"{folder}: expected a folder with .npz files of drives, found none")
        for path in found:
            arrays, terrain = _read(path)
            chosen = [i for i in SPLITS[split] if i < len(arrays["length"])]
            picked = {name: array[chosen] for name, array in arrays.items()}
            parts.append({**picked, "world": np.full(len(chosen), len(maps), np.int32)})
            maps.append(terrain)
        if not any(len(part["length"]) for part in parts[len(paths) :]):
            indices = SPLITS[split]
            raise DataError(
                f"{folder}: expected drives {indices.start} to {indices.stop - 1} of a file for "
                f"the {split} split, found fewer drives in every file"
            )
        paths += found
    if not paths:
        raise DataError("drives: expected a folder of drives or more, found none")
    return _join(paths, parts), stack(maps, [f"map of {path}" for path in paths])


def load_file(path: Path) -> tuple[Drives, TerrainMap]:
    """All drives of one file, with its map; raises like `load_drives`."""
    arrays, terrain = _read(path)
    world = np.zeros(len(arrays["length"]), np.int32)
    return _join([path], [{**arrays, "world": world}]), terrain


def _read(path: Path) -> tuple[dict[str, np.ndarray], TerrainMap]:
    """The arrays of all drives of a file and its map."""
    arrays, meta = schema.read(path)
    terrain = files.load_map(schema.find_map(path, meta["map"]))
    arrays = schema.check(path, arrays, terrain.offset())
    _check_place(path, arrays, terrain)
    if "wheel_class" not in arrays:
        wheels = np.asarray(meta["vehicle"]["wheels_in_body_xy"], np.float32)
        arrays["wheel_class"] = _look_up_classes(terrain, arrays["state"], wheels)
    schema.check_classes(path, arrays["wheel_class"], len(terrain.class_names))
    kinds = {"length": np.int32, "wheel_class": np.uint8}
    return arrays | {name: arrays[name].astype(kind) for name, kind in kinds.items()}, terrain


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


def _join(paths: list[Path], parts: list[dict[str, np.ndarray]]) -> Drives:
    """All parts one after the other, padded to the longest drive."""
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
    return Drives(**joined, wheels=signals, vehicles=tuple(map(schema.vehicle_name, paths)))
