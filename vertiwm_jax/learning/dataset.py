"""Recorded drives on disk: the schema, its validation, and prediction windows.

A collection is a folder of `.npz` files, one a world, each with K drives of T steps at 10 Hz:

    state        [K, T + 1, 12]  p_world m, roll pitch yaw rad, v_body m/s, omega_body rad/s
    control      [K, T, 2]       commanded speed m/s and front-wheel angle rad, from t to t + 1
    length       [K]             valid steps of each drive
    wheel_class  [K, T + 1, 4]   ground class under each wheel
    meta         text            JSON with "map", the file name of the terrain map

Maps lie in a folder `maps` inside the collection or beside it.
"""

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import TerrainMap, stack

Split = Literal["train", "validation", "test"]
SPLITS: dict[Split, range] = {
    "train": range(20),
    "validation": range(20, 22),
    "test": range(22, 25),
}
"""Drives of each file by index, as the collections are split."""

GROUNDS = ("rigid", "deformable", "transition")
"""Kinds of window, by the ground under the wheels: all rigid, all soil, or both."""

_LARGEST_SPEED = 50.0
_LARGEST_COORDINATE = 1e5


class DataError(ValueError):
    """Recorded drives that cannot be used; the message names file, field and expectation."""


@dataclass(frozen=True)
class Drives:
    """D drives of T steps, in host memory.

    state: `[D, T + 1, 12]` float32; control: `[D, T, 2]` float32; length: `[D]` steps;
    wheel_class: `[D, T + 1, 4]` uint8; world: `[D]` index into the terrain map.
    """

    state: np.ndarray
    control: np.ndarray
    length: np.ndarray
    wheel_class: np.ndarray
    world: np.ndarray


@struct.dataclass
class Windows:
    """N windows of C context steps and K predicted ones.

    state: `[N, C + K + 1, 12]`; control: `[N, C + K, 2]`; world: `[N]`;
    ground: `[N]` index into `GROUNDS`, over the predicted steps; context: C, static.
    """

    state: jax.Array
    control: jax.Array
    world: jax.Array
    ground: jax.Array
    context: int = struct.field(pytree_node=False)


def load(folder: str | Path, split: Split) -> tuple[Drives, TerrainMap]:
    """One split of a collection with its maps; `DataError` on anything malformed."""
    folder = Path(folder)
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise DataError(f"{folder}: expected a folder with .npz files of drives, found none")
    parts, maps = [], []
    for world, path in enumerate(paths):
        arrays, map_name = _read(path)
        chosen = [i for i in SPLITS[split] if i < len(arrays["length"])]
        picked = {name: array[chosen] for name, array in arrays.items()}
        parts.append({**picked, "world": np.full(len(chosen), world, np.int32)})
        maps.append(files.load(_find_map(folder, path, map_name)))
        _check_classes(path, arrays["wheel_class"], len(maps[-1].class_names))
    steps = {part["control"].shape[1] for part in parts}
    if len(steps) > 1:
        raise DataError(f"{folder}: expected files of equally long drives, found {sorted(steps)}")
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    if not len(joined["length"]):
        indices = SPLITS[split]
        raise DataError(
            f"{folder}: expected drives {indices.start} to {indices.stop - 1} of a file for the "
            f"{split} split, found fewer drives in every file"
        )
    return Drives(**joined), stack(maps)


def cut(
    drives: Drives, terrain: TerrainMap, context: int = 16, horizon: int = 16, stride: int = 4
) -> Windows:
    """All windows of `context` recorded and `horizon` predicted steps, every `stride` steps."""
    index = [
        (drive, start)
        for drive, length in enumerate(drives.length)
        for start in range(0, int(length) - context - horizon + 1, stride)
    ]
    if not index:
        raise DataError(
            f"expected drives of at least {context + horizon} steps, "
            f"found at most {int(drives.length.max())}"
        )
    drive, start = np.array(index).T
    steps = start[:, None] + np.arange(context + horizon + 1)
    drive = drive[:, None]
    soft = np.asarray(terrain.deformable)[drives.wheel_class[drive, steps[:, context:]]]
    share = soft.mean(axis=(1, 2))
    ground = np.where(share == 0, 0, np.where(share == 1, 1, 2))
    return Windows(
        state=jnp.asarray(drives.state[drive, steps]),
        control=jnp.asarray(drives.control[drive, steps[:, :-1]]),
        world=jnp.asarray(drives.world[drive[:, 0]]),
        ground=jnp.asarray(ground, jnp.int32),
        context=context,
    )


def _read(path: Path) -> tuple[dict[str, np.ndarray], str]:
    """The arrays of one file, checked, and the name of its map."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            missing = [name for name in (*_SHAPES, "meta") if name not in archive]
            if missing:
                raise DataError(f"{path}: missing {', '.join(missing)}; found {archive.files}")
            arrays = {name: archive[name] for name in _SHAPES}
            meta = str(archive["meta"])
    except (OSError, EOFError, zipfile.BadZipFile, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path}: expected an .npz archive of plain arrays: {error}") from error
    _check_shapes(path, arrays)
    _check_values(path, arrays)
    try:
        map_name = json.loads(meta)["map"]
    except (json.JSONDecodeError, KeyError, TypeError):
        map_name = None
    if not isinstance(map_name, str):
        raise DataError(
            f'{path}: meta: expected JSON with "map", the file name of the terrain map; '
            f"found {meta[:80]}"
        )
    return arrays, map_name


_SHAPES = {
    "state": ("K", "T + 1", 12),
    "control": ("K", "T", 2),
    "length": ("K",),
    "wheel_class": ("K", "T + 1", 4),
}


def _check_shapes(path: Path, arrays: dict[str, np.ndarray]) -> None:
    control = arrays["control"].shape
    if len(control) != 3:
        raise DataError(f"{path}: control: expected shape [K, T, 2], found {list(control)}")
    sizes = {"K": control[0], "T": control[1], "T + 1": control[1] + 1}
    for name, shape in _SHAPES.items():
        wanted = tuple(size if isinstance(size, int) else sizes[size] for size in shape)
        if arrays[name].shape != wanted:
            raise DataError(
                f"{path}: {name}: expected shape {list(wanted)} (K and T as in control), "
                f"found {list(arrays[name].shape)}"
            )
    if not control[0]:
        raise DataError(f"{path}: control: expected one drive or more, found shape {list(control)}")
    for name in ("state", "control"):
        if arrays[name].dtype.kind not in "fiu":
            raise DataError(f"{path}: {name}: expected numbers, found dtype {arrays[name].dtype}")


def _check_values(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Finite where valid, and in SI units: degrees, millimetres and km/h are told apart."""
    length, steps = arrays["length"], arrays["control"].shape[1]
    if not np.issubdtype(length.dtype, np.integer) or length.min() < 0 or length.max() > steps:
        raise DataError(f"{path}: length: expected integers in 0 to {steps}, found {length}")
    valid = np.arange(steps + 1) <= length[:, None]
    state, control = arrays["state"][valid], arrays["control"][valid[:, 1:]]
    limits = (
        ("state", state[:, 0:3], _LARGEST_COORDINATE, "position in m"),
        ("state", state[:, 3:6], 2 * np.pi, "roll, pitch and yaw in rad"),
        ("state", state[:, 6:9], _LARGEST_SPEED, "velocity in m/s"),
        ("state", state[:, 9:12], 10 * np.pi, "angular velocity in rad/s"),
        ("control", control[:, 0], _LARGEST_SPEED, "commanded speed in m/s"),
        ("control", control[:, 1], np.pi / 2, "front-wheel angle in rad"),
    )
    for name, values, limit, meaning in limits:
        bad = ~(np.abs(values) <= limit)
        if bad.any():
            raise DataError(
                f"{path}: {name}: expected finite {meaning} within {limit:.4g}, "
                f"found {values[bad][0]:.4g} among {bad.sum()} such values"
            )


def _check_classes(path: Path, wheel_class: np.ndarray, classes: int) -> None:
    integers = np.issubdtype(wheel_class.dtype, np.integer)
    if not integers or wheel_class.min() < 0 or wheel_class.max() >= classes:
        raise DataError(
            f"{path}: wheel_class: expected class ids 0 to {classes - 1} of its map, found "
            f"{wheel_class.dtype} from {wheel_class.min()} to {wheel_class.max()}"
        )


def _find_map(folder: Path, path: Path, name: str) -> Path:
    places = [folder / "maps" / name, folder.parent / "maps" / name]
    for place in places:
        if place.is_file():
            return place
    raise DataError(f"{path}: meta: its map {name} was expected at {places[0]} or {places[1]}")
