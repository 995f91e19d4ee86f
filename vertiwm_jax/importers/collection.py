"""Writes imported drives as a collection: files in the schema, and their map."""

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from vertiwm_jax import runs
from vertiwm_jax.importers.resampling import Drive
from vertiwm_jax.learning.dataset import SPLITS
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain import files, query
from vertiwm_jax.terrain.map import TerrainMap

MAP = "map.npz"
PER_FILE = SPLITS["test"].stop
"""Drives in a file. The first of them are for training, the last for tests."""


def arrays(drives: Sequence[Drive]) -> dict[str, np.ndarray]:
    """K drives as arrays of the schema; shorter drives are padded with their last values."""
    steps = max(len(drive.control) for drive in drives)

    def filled(array: np.ndarray, length: int) -> np.ndarray:
        return np.pad(array, [(0, length - len(array)), (0, 0)], "edge").astype(np.float32)

    return {
        "state": np.stack([filled(drive.state, steps + 1) for drive in drives]),
        "control": np.stack([filled(drive.control, steps) for drive in drives]),
        "length": np.array([len(drive.control) for drive in drives], np.int32),
    }


def write(
    folder: Path,
    drives: Sequence[Drive],
    terrain: TerrainMap,
    wheels_in_body_xy: list[list[float]],
    meta: dict[str, Any],
) -> None:
    """Writes all drives, in their order, and the map into an empty folder."""
    (folder / "maps").mkdir()
    files.save(terrain, folder / "maps" / MAP)
    vehicle = {"wheels_in_body_xy": wheels_in_body_xy}
    text = json.dumps({**meta, "map": MAP, "dt": STEP_SECONDS, "vehicle": vehicle})
    for number, first in enumerate(range(0, len(drives), PER_FILE)):
        stream = io.BytesIO()
        columns = arrays(drives[first : first + PER_FILE])
        np.savez_compressed(stream, allow_pickle=False, meta=np.array(text), **columns)
        runs.write_atomic(folder / f"drives_{number:03d}.npz", stream.getvalue())


def on_map(terrain: TerrainMap, drive: Drive) -> bool:
    """Whether the body origin stays within the heights of the map."""
    rows, columns = terrain.elevation.shape[1:]
    extent = float(terrain.resolution) * np.array([columns - 1, 1 - rows])
    corners = np.sort([np.asarray(terrain.origin), np.asarray(terrain.origin) + extent], axis=0)
    xy = drive.state[:, :2]
    return bool(((xy >= corners[0]) & (xy <= corners[1])).all())


def clearance(terrain: TerrainMap, drives: Sequence[Drive]) -> np.ndarray:
    """`[3]` quartiles of the height of the body origin above the ground, m."""
    position = np.concatenate([drive.state[:, :3] for drive in drives])
    ground = query.surface(terrain, jnp.asarray(position[:, :2], jnp.float32)).height
    return np.quantile(position[:, 2] - np.asarray(ground), [0.25, 0.5, 0.75])
