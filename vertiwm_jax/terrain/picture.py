"""Maps from above: hill-shaded, in the colors of their ground, with a legend."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from vertiwm_jax import figures

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    from vertiwm_jax.terrain.map import TerrainMap

OBSTACLE = 0.15
"""Shade of gray of rocks and trees."""


def extent(terrain: TerrainMap) -> tuple[float, float, float, float]:
    """West, east, south and north edge of the map, m."""
    (west, south), (east, north) = np.asarray(terrain.extent).tolist()
    return west, east, south, north


def pale(rgb: np.ndarray) -> np.ndarray:
    """`[..., 3]` colors of ground classes, 0 to 255, as maps are tinted, in [0, 1]."""
    return 0.45 + 0.55 * rgb / 255


def shaded(terrain: TerrainMap, world: int, enlarge: int = 4) -> np.ndarray:
    """`[H, W, 3]` in [0, 1], north up: pale class colors, with light from the north-west.

    H, W are `enlarge` pixels for each cell between vertices; heights are interpolated.
    """
    elevation = np.asarray(terrain.elevation[world], np.float64)
    rows, columns = elevation.shape
    center = [(np.arange((n - 1) * enlarge) + 0.5) / enlarge for n in (rows, columns)]
    fine = np.stack([np.interp(center[1], np.arange(columns), line) for line in elevation])
    fine = np.stack([np.interp(center[0], np.arange(rows), line) for line in fine.T], axis=1)
    spacing = float(terrain.resolution) / enlarge
    south, east = np.gradient(fine, spacing)
    # Lambert's law; light 45 degrees above the horizon.
    light = np.array([-0.5, 0.5, np.sqrt(0.5)])
    shade = (-light[0] * east + light[1] * south + light[2]) / np.sqrt(1 + east**2 + south**2)

    semantic = np.asarray(terrain.semantic[world])
    row, column = (
        np.minimum(at / (n - 1) * cells, cells - 1).astype(int)
        for at, n, cells in zip(center, (rows, columns), semantic.shape, strict=True)
    )
    tint = pale(np.asarray(terrain.class_rgb)[semantic[row[:, None], column]])
    picture = tint * (0.35 + 0.75 * np.clip(shade, 0, 1))[..., None]
    x = float(terrain.origin[0]) + center[1] * float(terrain.resolution)
    y = float(terrain.origin[1]) - center[0] * float(terrain.resolution)
    for left, north, wide, tall, height in np.asarray(terrain.obstacles[world]):
        if height > 0:
            over = (np.abs(y - north) <= tall / 2)[:, None] & (np.abs(x - left) <= wide / 2)
            picture[over] = OBSTACLE
    return np.clip(picture, 0, 1)


def plot(terrain: TerrainMap, names: Sequence[str] | None = None, most: int = 12) -> Figure:
    """The worlds of a map from above, up to `most` of them, with a legend of their ground.

    names: of all worlds; their numbers by default.
    """
    names = names or [f"world {world}" for world in range(terrain.worlds)]
    shown = range(min(terrain.worlds, most))
    columns = min(len(shown), 4)
    rows = math.ceil(len(shown) / columns)
    size = 4.6 if len(shown) == 1 else 3.0
    with figures.style():
        figure = figures.sheet(size * columns, size * rows + 0.5)
        panels = figure.subplots(rows, columns, squeeze=False)
        for world, axes in zip(shown, panels.flat, strict=False):
            draw_map(axes, terrain, world, names[world])
        for axes in panels.flat[len(shown) :]:
            axes.set_axis_off()
        legend = ground_legend(terrain, shown)
        figure.legend(handles=legend, loc="outside upper center", ncols=min(len(legend), 6))
    return figure


def draw_map(axes: Axes, terrain: TerrainMap, world: int, title: str) -> None:
    """Draws one world into a panel: in its own coordinates, with those of its file at the axes."""
    axes.imshow(shaded(terrain, world), extent=extent(terrain))
    axes.grid(False)
    offset = terrain.offset(world)
    if offset.any():
        for axis, first in zip((axes.xaxis, axes.yaxis), offset.tolist(), strict=True):
            axis.set_major_formatter(lambda place, _, first=first: f"{first + place:.10g}")
        axes.locator_params(nbins=3)  # Such numbers are long.
    axes.set(xlabel="x [m], east", ylabel="y [m], north", title=title)


def ground_legend(terrain: TerrainMap, shown: Sequence[int]) -> list[Patch]:
    """A color for each class of ground in some worlds, and for obstacles."""
    from matplotlib.patches import Patch

    present = np.unique(np.asarray(terrain.semantic)[list(shown)])
    colors = pale(np.asarray(terrain.class_rgb))
    legend = [Patch(facecolor=tuple(colors[k]), label=terrain.class_names[k]) for k in present]
    if (np.asarray(terrain.obstacles)[list(shown), :, 4] > 0).any():
        legend.append(Patch(facecolor=str(OBSTACLE), label="rock or tree"))
    return legend
