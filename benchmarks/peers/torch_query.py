"""The terrain map in PyTorch: patches by `grid_sample`, and ground under points.

As `vertiwm_jax.terrain.query`, for the patches of the shipped model: heights relative to the
vehicle, bilinear, and the color of the cell of each pixel.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.patches import PATCH_METERS, PATCH_PIXELS, RELIEF_METERS

SOIL = ("kc", "kphi", "n", "cohesion", "friction_angle", "shear_modulus")
"""Columns of a soil, named as in `terrain.soil.Soil`."""


def tensor(array: jax.Array | np.ndarray) -> Tensor:
    """A copy of any array."""
    return torch.from_numpy(np.array(array))


_PLACES = (2 * torch.arange(PATCH_PIXELS) + 1) / PATCH_PIXELS - 1
_NORTH_UP = torch.tensor([1.0, -1.0])


class Ground(NamedTuple):
    """The map under each vehicle of a batch, or of each world.

    heights: `[B, 1, R, C]` m, on vertices. colors: `[B, 3, r, c]` in [-1, 1], of cells.
    semantic: `[B, r, c]` class ids. friction: `[B, r, c]`, 0 on soil.
    deformable: `[K]` bool. soils: `[K, 6]`, in the order of `SOIL`.
    origin: `[2]` x, y of vertex (0, 0), m. extent: `[2]` m. resolution: m between vertices.
    """

    heights: Tensor
    colors: Tensor
    semantic: Tensor
    friction: Tensor
    deformable: Tensor
    soils: Tensor
    origin: Tensor
    extent: Tensor
    resolution: float

    @classmethod
    def of(cls, terrain: TerrainMap) -> "Ground":
        """All worlds of a map."""
        palette = np.asarray(terrain.class_rgb, np.float32) / 127.5 - 1
        semantic, grip = np.asarray(terrain.semantic, np.int64), terrain.grip
        _, rows, columns = terrain.elevation.shape
        resolution = float(terrain.resolution)
        soils: Any = [getattr(query.soils(terrain), name) for name in SOIL]
        return cls(
            heights=tensor(terrain.elevation)[:, None],
            colors=tensor(palette[semantic].transpose(0, 3, 1, 2)).contiguous(),
            semantic=tensor(semantic),
            friction=tensor(terrain.friction if grip is None else grip * terrain.friction),
            deformable=tensor(terrain.deformable),
            soils=tensor(np.stack(soils, axis=-1)),
            origin=tensor(terrain.origin),
            extent=resolution * torch.tensor([columns - 1.0, rows - 1.0]),
            resolution=resolution,
        )

    def select(self, worlds: Tensor) -> "Ground":
        """The world `[B]` of each vehicle: `grid_sample` wants one image for each."""
        return self._replace(
            heights=self.heights[worlds],
            colors=self.colors[worlds],
            semantic=self.semantic[worlds],
            friction=self.friction[worlds],
        )


class Surface(NamedTuple):
    """The ground at points: height `[B, N]` m, gradient `[B, N, 2]`, class id, friction."""

    height: Tensor
    gradient: Tensor
    semantic: Tensor
    friction: Tensor


def patches(ground: Ground, state: Tensor) -> tuple[Tensor, Tensor]:
    """States `[B, 12]` to elevation `[B, 1, 128, 128]` and colors `[B, 3, 128, 128]`.

    Row 0 is farthest ahead, column 0 farthest left; both in [-1, 1].
    """
    cos, sin = torch.cos(state[:, 5, None, None]), torch.sin(state[:, 5, None, None])
    across, down = (PATCH_METERS / ground.extent).unbind()
    x, y = (2 * (state[:, :2] - ground.origin) / ground.extent)[..., None, None].unbind(1)
    # Sums of a row and a column, in two planes: affine_grid takes several times as long.
    u, v = _PLACES, _PLACES[:, None]
    columns = (x - 1 - across * cos * v) + across * sin * u
    rows = (-y - 1 + down * sin * v) + down * cos * u
    grid = torch.stack([columns, rows], dim=1).permute(0, 2, 3, 1)
    heights = F.grid_sample(
        ground.heights, grid, mode="bilinear", padding_mode="border", align_corners=True
    )
    colors = F.grid_sample(
        ground.colors, grid, mode="nearest", padding_mode="border", align_corners=False
    )
    elevation = (heights - state[:, 2, None, None, None]) / RELIEF_METERS
    return elevation.clamp(-1, 1), colors


def surface(ground: Ground, xy: Tensor) -> Surface:
    """The ground as wheels meet it at points `[B, N, 2]` p_world, m.

    Between vertices, soil is bilinear and rigid ground two triangles.
    """
    _, _, rows, columns = ground.heights.shape
    _, cell_rows, cell_columns = ground.semantic.shape
    vehicle = torch.arange(len(xy))[:, None]
    from_corner = (xy - ground.origin) * _NORTH_UP
    column, row = (from_corner / ground.resolution).unbind(-1)
    column, row = column.clamp(0, columns - 1), row.clamp(0, rows - 1)

    i = (row * (cell_rows / (rows - 1))).long().clamp(max=cell_rows - 1)
    j = (column * (cell_columns / (columns - 1))).long().clamp(max=cell_columns - 1)
    semantic = ground.semantic[vehicle, i, j]
    soft = ground.deformable[semantic]

    r, c = row.long().clamp(max=rows - 2), column.long().clamp(max=columns - 2)
    fx, fy = column - c, 1 - (row - r)
    heights = ground.heights[:, 0]
    bottom_left = heights[vehicle, r + 1, c]
    along = heights[vehicle, r + 1, c + 1] - bottom_left
    up = heights[vehicle, r, c] - bottom_left
    twist = heights[vehicle, r, c + 1] - bottom_left - up - along
    rising = (fx > fy).float()
    height = bottom_left + fx * along + fy * up
    height = height + twist * torch.where(soft, fx * fy, torch.minimum(fx, fy))
    slope_x = along + twist * torch.where(soft, fy, 1 - rising)
    slope_y = up + twist * torch.where(soft, fx, rising)
    inside = (from_corner >= 0) & (from_corner <= ground.extent)
    gradient = torch.stack([slope_x, slope_y], dim=-1) / ground.resolution
    return Surface(height, gradient * inside, semantic, ground.friction[vehicle, i, j])
