"""Logs of x, y and yaw alone, set on the ground."""

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from vertiwm_jax.importers.log import Log
from vertiwm_jax.importers.settings import ImportSettings
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.mechanics.kinematic import SPEED_LAG, BicycleParams, place
from vertiwm_jax.precision import float32
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain.map import TerrainMap

_LEVEL = 1e-9  # m and rad
_AROUND, _FARTHEST = 30.0, 5e4
"""m of a plane around a log, and from its middle at most."""
_CELLS = 500
_AT_ONCE = 4096


def is_planar(log: Log) -> bool:
    """Whether z never changes, and roll and pitch are 0: a localizer in two dimensions."""
    tilt = log.rotation.as_quat()[:, :2]
    return bool(np.ptp(log.position[:, 2]) < _LEVEL and np.abs(tilt).max() < _LEVEL)


def plane(logs: Sequence[Log], ground: str) -> TerrainMap:
    """Level ground of one class below logs, at a height of 0."""
    xy = np.concatenate([log.position[:, :2] for log in logs])
    middle = np.median(xy, axis=0)
    reach = min(np.abs(xy - middle).max(), _FARTHEST) + _AROUND
    heights = np.zeros((_CELLS + 1, _CELLS + 1))
    corner = middle + [-reach, reach]
    return TerrainMap.from_array(
        heights, ground, resolution=2 * reach / _CELLS, origin=corner, name="plane"
    )


def lifted(log: Log, terrain: TerrainMap, settings: ImportSettings) -> Log:
    """A planar log with the height, roll and pitch of the ground below its four wheels.

    log, terrain: in the same coordinates, at full size. Velocities are left to be found from the
    poses. Raises `DataError` if the settings do not say how large wheels are.
    """
    vehicle = settings.vehicle
    if vehicle.wheel_radius is None:
        raise DataError(
            f"{log.name}: z, roll and pitch: expected some that change, or the vehicle's "
            "wheel_radius in the settings, to set it on the ground; found x, y and yaw alone"
        )
    lengths = vehicle.wheelbase, vehicle.track, vehicle.wheel_radius
    long, wide, high = (jnp.float32(vehicle.scale * length) for length in lengths)
    wheels = BicycleParams(long, wide, high, jnp.float32(SPEED_LAG))
    point = vehicle.scale * np.asarray(vehicle.logged_point)
    yaw = log.rotation.as_euler("ZYX")[:, 0]
    middle = log.position - Rotation.from_rotvec(np.outer(yaw, [0, 0, 1])).apply(point)
    placed = []
    for first in range(0, len(yaw), _AT_ONCE):  # Few shapes are compiled.
        some = np.column_stack([middle[:, :2], yaw])[first : first + _AT_ONCE]
        filled = np.pad(some, [(0, _AT_ONCE - len(some)), (0, 0)], "edge")
        state = _place(terrain, filled[:, :2], filled[:, 2], wheels)
        placed.append(np.concatenate([state.position, state.rpy], 1)[: len(some)])
    pose = np.concatenate(placed).astype(float)
    rotation = Rotation.from_euler("ZYX", np.column_stack([yaw, pose[:, 4], pose[:, 3]]))
    position = np.column_stack([middle[:, :2], pose[:, 2]]) + rotation.apply(point)
    attitude = rotation.as_quat()
    return replace(log, position=position, attitude=attitude, velocity=None, angular_velocity=None)


@float32
@jax.jit
def _place(
    terrain: TerrainMap, xy: jax.Array, yaw: jax.Array, vehicle: BicycleParams
) -> VehicleState:
    return jax.vmap(lambda xy, yaw: place(terrain, xy, yaw, vehicle=vehicle))(xy, yaw)
