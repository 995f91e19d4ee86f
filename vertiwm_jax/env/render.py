"""Pictures of a vehicle on its world from above."""

import numpy as np

from vertiwm_jax.env.task import TaskState
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.terrain import picture as pictures
from vertiwm_jax.terrain.map import TerrainMap

_VEHICLE, _GOAL = (0.80, 0.05, 0.05), (0.00, 0.25, 0.75)


def from_above(
    terrain: TerrainMap, vehicle: Vehicle, state: TaskState, goal_radius: float
) -> np.ndarray:
    """`[H, W, 3]` uint8, north up: the vehicle as a red box with a white nose, the goal a ring."""
    picture = pictures.shaded(terrain, int(state.world))
    west, east, south, north = pictures.extent(terrain)
    (east_of, north_of, _), yaw = np.asarray(state.vehicle.position), float(state.vehicle.rpy[2])
    goal = np.asarray(state.goal)
    height, width, _ = picture.shape
    x = west + (np.arange(width) + 0.5) * (east - west) / width
    y = (north - (np.arange(height) + 0.5) * (north - south) / height)[:, None]
    pixel = (east - west) / width
    ring = np.abs(np.hypot(x - goal[0], y - goal[1]) - goal_radius) < 1.5 * pixel
    picture[ring] = _GOAL
    ahead = np.cos(yaw) * (x - east_of) + np.sin(yaw) * (y - north_of)
    left = np.cos(yaw) * (y - north_of) - np.sin(yaw) * (x - east_of)
    body = (np.abs(ahead) <= vehicle.length / 2) & (np.abs(left) <= vehicle.width / 2)
    picture[body] = _VEHICLE
    picture[body & (ahead > vehicle.length / 4)] = 1.0
    return (255 * picture).round().astype(np.uint8)
