"""Builds the map of a collection from the GridMap messages of its bags."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from vertiwm_jax.importers import rosbag
from vertiwm_jax.importers.settings import Frames, GridMapSettings
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.terrain.classes import STANDARD
from vertiwm_jax.terrain.map import TerrainMap

_KIND = "grid_map_msgs/msg/GridMap"
_MOST_CELLS = 10**8


class Canvas:
    """A raster of layers that grows as patches are painted; the newest value of a cell counts.

    values: `[L, I, J]`, NaN where there are none; origin: `[2]` x, y of cell (0, 0), m.
    """

    def __init__(self, patch: np.ndarray, origin: np.ndarray, resolution: float) -> None:
        self.values, self.origin, self.resolution = patch, origin, resolution

    def paint(self, patch: np.ndarray, origin: np.ndarray) -> None:
        """`[L, I, J]` values, NaN where there are none, of which cell (0, 0) lies at `[2]` m.

        Raises `ValueError` where all patches together lie too far apart.
        """
        offset = np.rint((origin - self.origin) / self.resolution)
        before = np.maximum(-offset, 0)
        after = np.maximum(offset + patch.shape[1:] - self.values.shape[1:], 0)
        size = before + self.values.shape[1:] + after
        if not np.prod(size) <= _MOST_CELLS:
            x, y = self.resolution * size / 1000
            raise ValueError(
                f"expected all maps within {_MOST_CELLS:,} cells, found {x:,.3f} km x {y:,.3f} km"
            )
        first, before, after = (x.astype(int) for x in (offset, before, after))
        if before.any() or after.any():
            margins = [(0, 0), *zip(before, after, strict=True)]
            self.values = np.pad(self.values, margins, constant_values=np.nan)
            self.origin = self.origin - self.resolution * before
        i, j = first + before
        under = self.values[:, i : i + patch.shape[1], j : j + patch.shape[2]]
        under[:] = np.where(np.isfinite(patch), patch, under)


def terrain(
    paths: Sequence[Path],
    wanted: GridMapSettings,
    frames: Frames,
    said: dict[str, int] | None = None,
) -> tuple[TerrainMap, float]:
    """The map from all messages of the bags, and the share of its cells that no message covers.

    said: what is said of messages that are left out, and how many there are. Cells that no message
    covers take the height of the nearest cell. Raises `DataError` naming bag, topic and
    expectation, and `MapError` if the heights make no map.
    """
    names = [wanted.elevation] + ([wanted.semantic] if wanted.semantic else [])
    canvas, said = None, {} if said is None else said
    for path in paths:
        name = f"{path}: {wanted.topic}"
        for _, message in rosbag.messages(path, wanted.topic, (_KIND,), said, False):
            patch, origin = _patch(name, message, names)
            canvas = canvas or Canvas(patch, origin, message.info.resolution)
            if not np.isclose(message.info.resolution, canvas.resolution):
                raise DataError(
                    f"{name}: expected {canvas.resolution:g} m between cells as before, found "
                    f"{message.info.resolution:g}"
                )
            try:
                canvas.paint(patch, origin)
            except ValueError as error:
                raise DataError(f"{name}: {error}") from None
    name = f"{paths[0]}: {wanted.topic}"
    if canvas is None:
        raise DataError(f"{name}: expected messages of {_KIND}, found none")
    known = np.isfinite(canvas.values[0])
    if not known.any():
        raise DataError(f"{name}: {wanted.elevation}: expected heights, found none that is finite")
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    heights = canvas.values[0][tuple(np.asarray(nearest))]
    ground = np.full(known.shape, STANDARD.names.index(wanted.ground))
    if wanted.semantic:
        layer = canvas.values[1]
        ground = np.where(np.isfinite(layer), np.rint(np.nan_to_num(layer)), ground).astype(int)
    x, y, z = frames.origin
    west, south = canvas.origin - [x, y]
    north = south + (known.shape[1] - 1) * canvas.resolution
    # Rows of a map go from the largest y to the smallest, columns along x.
    built = TerrainMap.from_array(
        (heights - z).T[::-1],
        ground.T[::-1],
        resolution=canvas.resolution,
        origin=(west, north),
        name=name,
    )
    return built, float(1 - known.mean())


def _patch(name: str, message: Any, layers: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """`[L, I, J]` layers by x and y, both rising, and `[2]` x, y of cell (0, 0), m."""
    info = message.info
    q = info.pose.orientation
    if abs(q.x) + abs(q.y) + abs(q.z) > 1e-6:
        raise DataError(f"{name}: expected a map along the axes of its frame, found a turned one")
    # Index (0, 0) lies at the largest x and y, once the ring buffer is unrolled.
    start = -message.outer_start_index, -message.inner_start_index
    patch = np.stack(
        [np.roll(_layer(name, message, layer), start, (0, 1))[::-1, ::-1] for layer in layers]
    )
    center = np.array([info.pose.position.x, info.pose.position.y])
    return patch, center - info.resolution * (np.array(patch.shape[1:]) - 1) / 2


def _layer(name: str, message: Any, layer: str) -> np.ndarray:
    """`[rows, columns]`, which fall in x and in y, as they lie in the ring buffer."""
    if layer not in message.layers:
        raise DataError(f"{name}: expected a layer {layer}, found {', '.join(message.layers)}")
    array = message.data[message.layers.index(layer)]
    outer, inner = array.layout.dim[0], array.layout.dim[1]
    labels = (outer.label, inner.label)
    values = np.asarray(array.data, np.float32).reshape(outer.size, inner.size)
    if labels == ("column_index", "row_index"):
        return values.T
    if labels == ("row_index", "column_index"):
        return values
    raise DataError(
        f"{name}: {layer}: expected dimensions column_index and row_index, found {labels}"
    )
