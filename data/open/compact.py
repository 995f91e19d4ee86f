"""`python data/open/compact.py RECORDINGS FOLDER`: stores drives in a tenth of the space.

A compact file is a file of the schema. Its numbers are float32, rounded to a fixed step that is a
power of two, so that most bits are zero and compress well. Arrays that the schema does not name are
left out, and values after the end of a drive repeat the last valid ones.
"""

import argparse
import io
import json
import sys
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from vertiwm_jax import atomic
from vertiwm_jax.errors import UserError
from vertiwm_jax.learning import schema
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import TerrainMap

STEPS: dict[str, np.ndarray] = {
    "state": 2.0 ** -np.repeat([12, 14, 12, 13], 3),  # m, rad, m/s, rad/s
    "control": 2.0 ** -np.array([12, 12]),  # m/s, rad
    "wheel_omega": np.array(2.0**-6),  # rad/s
    "wheel_sinkage": np.array(2.0**-13),  # m
    "wheel_force": np.array(2.0**5),  # N
    "chassis_force": np.array(2.0**5),  # N
    "steer_angle": np.array(2.0**-12),  # rad
}
"""Step to which each array is rounded; the error is at most half of it."""
ELEVATION_STEP = 2.0**-12
"""The same for heights of maps, m."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command; expected failures end in one line and a status that is not 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path, help="folders of drives, with maps")
    parser.add_argument("folder", type=Path, help="where to write them")
    given = parser.parse_args(arguments)
    try:
        sizes = write(given.recordings, given.folder)
    except (UserError, ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    for name, size in sizes.items():
        print(f"{name:<12} {size / 1e6:6.2f} MB")
    print(f"{'all':<12} {sum(sizes.values()) / 1e6:6.2f} MB")


def write(source: Path, destination: Path) -> dict[str, int]:
    """Compacts every collection in `source`, and gives the bytes written by folder.

    The same drives give the same bytes. Raises `DataError` or `MapError` on anything malformed,
    `WriteError` on what cannot be written.
    """
    paths = [path for path in sorted(source.glob("*/*.npz")) if path.parent.name != "maps"]
    if not paths:
        raise DataError(f"{source}: expected folders with .npz files of drives, found none")
    if source.resolve() == destination.resolve():
        raise DataError(f"{destination}: expected another folder than that of the recorded drives")
    maps: dict[Path, TerrainMap] = {}
    for path in paths:
        arrays, meta = schema.read(path)
        ground = schema.find_map(path, meta["map"])
        if ground not in maps:
            maps[ground] = files.load_map(ground)
        if "wheel_class" in arrays:
            schema.check_classes(path, arrays["wheel_class"], len(maps[ground].class_names))
        atomic.write(_target(path, source, destination), _archive(arrays, meta))
    for ground, terrain in maps.items():
        heights = jnp.asarray(_round(np.asarray(terrain.elevation), ELEVATION_STEP))
        files.save(replace(terrain, elevation=heights), _target(ground, source, destination))
    sizes: dict[str, int] = {}
    for path in (*paths, *maps):
        folder = str(path.parent.relative_to(source))
        size = _target(path, source, destination).stat().st_size
        sizes[folder] = sizes.get(folder, 0) + size
    return sizes


def _target(path: Path, source: Path, destination: Path) -> Path:
    """The path to write a file of `source` to; makes its folder."""
    target = destination / path.relative_to(source)
    target.parent.mkdir(parents=True, exist_ok=True)
    return target


def _archive(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> bytes:
    """An `.npz` archive by LZMA, which is a quarter smaller than deflate for rounded numbers."""
    stored = {name: _rounded(name, array, arrays["length"]) for name, array in arrays.items()}
    stored["meta"] = np.array(json.dumps(meta))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_LZMA) as archive:
        for name, array in stored.items():
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    return buffer.getvalue()


def _rounded(name: str, array: np.ndarray, length: np.ndarray) -> np.ndarray:
    """An array of the schema `[K, ...]` as a compact file has it, of drives of `length` `[K]`."""
    if name == "length":
        return array.astype(np.int32)
    if name == "split":
        return array
    last = length if name != "control" else np.maximum(length - 1, 0)
    index = np.minimum(np.arange(array.shape[1]), last[:, None])
    array = array[np.arange(len(array))[:, None], index]
    if name == "wheel_class":
        return array.astype(np.uint8)
    return _round(array, STEPS[name])


def _round(array: np.ndarray, step: np.ndarray | float) -> np.ndarray:
    return (np.round(array.astype(np.float64) / step) * step).astype(np.float32)


if __name__ == "__main__":
    main()
