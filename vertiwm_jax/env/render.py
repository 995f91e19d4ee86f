"""Pictures of worlds from above, hill-shaded and tinted, without and with a vehicle."""

import numpy as np

from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.terrain.map import TerrainMap

_PIXELS_A_VERTEX = 4
OBSTACLE = 0.15
"""Shade of gray of rocks and trees."""
_VEHICLE, _GOAL = (0.80, 0.05, 0.05), (0.00, 0.25, 0.75)


def extent(terrain: TerrainMap) -> tuple[float, float, float, float]:
    """West, east, south and north edge of the map, m."""
    (west, south), (east, north) = np.asarray(terrain.extent).tolist()
    return west, east, south, north


def pale(rgb: np.ndarray) -> np.ndarray:
    """`[..., 3]` colors of ground classes, 0 to 255, as maps are tinted, in [0, 1]."""
    return 0.45 + 0.55 * rgb / 255


def shaded(terrain: TerrainMap, world: int, enlarge: int = _PIXELS_A_VERTEX) -> np.ndarray:
    """`[H, W, 3]` in [0, 1], north up: pale class colors, with light from the north-west.

    H, W are `enlarge` pixels for each cell between vertices; heights are interpolated.
    """
    elevation = np.asarray(terrain.elevation[world], np.float64)
    rows, columns = elevation.shape
    centre = [(np.arange((n - 1) * enlarge) + 0.5) / enlarge for n in (rows, columns)]
    fine = np.stack([np.interp(centre[1], np.arange(columns), line) for line in elevation])
    fine = np.stack([np.interp(centre[0], np.arange(rows), line) for line in fine.T], axis=1)
    spacing = float(terrain.resolution) / enlarge
    south, east = np.gradient(fine, spacing)
    # Lambert's law; light 45 degrees above the horizon.
    light = np.array([-0.5, 0.5, np.sqrt(0.5)])
    shade = (-light[0] * east + light[1] * south + light[2]) / np.sqrt(1 + east**2 + south**2)

    semantic = np.asarray(terrain.semantic[world])
    row, column = (
        np.minimum(at / (n - 1) * cells, cells - 1).astype(int)
        for at, n, cells in zip(centre, (rows, columns), semantic.shape, strict=True)
    )
    tint = pale(np.asarray(terrain.class_rgb)[semantic[row[:, None], column]])
    picture = tint * (0.35 + 0.75 * np.clip(shade, 0, 1))[..., None]
    x = float(terrain.origin[0]) + centre[1] * float(terrain.resolution)
    y = float(terrain.origin[1]) - centre[0] * float(terrain.resolution)
    for left, north, wide, tall, height in np.asarray(terrain.obstacles[world]):
        if height > 0:
            over = (np.abs(y - north) <= tall / 2)[:, None] & (np.abs(x - left) <= wide / 2)
            picture[over] = OBSTACLE
    return np.clip(picture, 0, 1)


def from_above(
    terrain: TerrainMap,
    world: int,
    position: np.ndarray,
    yaw: float,
    goal: np.ndarray,
    goal_radius: float,
    vehicle: Vehicle,
) -> np.ndarray:
    """`[H, W, 3]` uint8, north up: the vehicle as a red box with a white nose, the goal a ring."""
    picture = shaded(terrain, world)
    west, east, south, north = extent(terrain)
    height, width, _ = picture.shape
    x = west + (np.arange(width) + 0.5) * (east - west) / width
    y = (north - (np.arange(height) + 0.5) * (north - south) / height)[:, None]
    pixel = (east - west) / width
    ring = np.abs(np.hypot(x - goal[0], y - goal[1]) - goal_radius) < 1.5 * pixel
    picture[ring] = _GOAL
    ahead = np.cos(yaw) * (x - position[0]) + np.sin(yaw) * (y - position[1])
    left = np.cos(yaw) * (y - position[1]) - np.sin(yaw) * (x - position[0])
    body = (np.abs(ahead) <= vehicle.length / 2) & (np.abs(left) <= vehicle.width / 2)
    picture[body] = _VEHICLE
    picture[body & (ahead > vehicle.length / 4)] = 1.0
    return (255 * picture).round().astype(np.uint8)
