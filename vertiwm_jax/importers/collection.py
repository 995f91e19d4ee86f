"""Writes imported drives as a collection: files in the schema, and their map."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from vertiwm_jax.importers.resampling import Drive
from vertiwm_jax.learning import schema
from vertiwm_jax.learning.dataset import SPLITS
from vertiwm_jax.terrain import files, query
from vertiwm_jax.terrain.map import TerrainMap

MAP = "map.npz"
PER_FILE = SPLITS["test"].stop
"""Drives in a file. The first of them are for training, the last for tests."""


def arrays(drives: Sequence[Drive]) -> dict[str, np.ndarray]:
    """K drives as arrays of the schema; shorter drives are padded with their last values."""
    return schema.join([{"state": drive.state, "control": drive.control} for drive in drives])


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
    for number, first in enumerate(range(0, len(drives), PER_FILE)):
        path, some = folder / f"drives_{number:03d}.npz", drives[first : first + PER_FILE]
        schema.write(path, arrays(some), {**meta, "map": MAP}, wheels_in_body_xy)


def on_map(terrain: TerrainMap, drive: Drive) -> bool:
    """Whether the body origin stays within the heights of the map."""
    low, high = map(np.asarray, terrain.extent)
    xy = drive.state[:, :2]
    return bool(((xy >= low) & (xy <= high)).all())


def clearance(terrain: TerrainMap, drives: Sequence[Drive]) -> np.ndarray:
    """`[3]` quartiles of the height of the body origin above the ground, m."""
    position = np.concatenate([drive.state[:, :3] for drive in drives])
    ground = query.surface(terrain, jnp.asarray(position[:, :2], jnp.float32)).height
    return np.quantile(position[:, 2] - np.asarray(ground), [0.25, 0.5, 0.75])
