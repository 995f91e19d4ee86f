"""A drive whose states are known at every moment, and what sensors at odd moments see of it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from vertiwm_jax.importers.settings import ImportSettings, VehicleSettings
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain.map import TerrainMap

VEHICLE = VehicleSettings(wheelbase=2.0, track=1.2)
SETTINGS = ImportSettings(vehicle=VEHICLE)
POSITION_NOISE, ANGLE_NOISE = 0.01, 0.002
"""Standard deviations of each logged pose, m and rad."""


def states(time: np.ndarray) -> np.ndarray:
    """`[N]` s to the `[N, 12]` true states: loops of about 3 m/s on waves, by derivatives on paper.

    Angular velocities are those of roll, pitch and yaw rates (R = Rz Ry Rx), not of a logarithm.
    """
    t = np.asarray(time, float)
    position = np.stack([20 * np.sin(0.15 * t), 8 * np.sin(0.3 * t), 0.5 * np.cos(0.4 * t)], 1)
    moved = np.stack([3 * np.cos(0.15 * t), 2.4 * np.cos(0.3 * t), -0.2 * np.sin(0.4 * t)], 1)
    roll, pitch = 0.15 * np.sin(0.8 * t), 0.2 * np.sin(0.6 * t + 1)
    # Faces where it moves.
    (along_x, along_y, _), pushed_x, pushed_y = (
        moved.T,
        -0.45 * np.sin(0.15 * t),
        -0.72 * np.sin(0.3 * t),
    )
    yaw = np.arctan2(along_y, along_x)
    roll_rate, pitch_rate = 0.12 * np.cos(0.8 * t), 0.12 * np.cos(0.6 * t + 1)
    yaw_rate = (along_x * pushed_y - along_y * pushed_x) / (along_x**2 + along_y**2)
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
    world_from_body = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    velocity = np.einsum("ijn,ni->nj", world_from_body, moved)
    omega = np.stack(
        [
            roll_rate - yaw_rate * sp,
            pitch_rate * cr + yaw_rate * cp * sr,
            -pitch_rate * sr + yaw_rate * cp * cr,
        ],
        axis=1,
    )
    wrapped = (yaw + np.pi) % (2 * np.pi) - np.pi
    rpy = np.stack([roll, pitch, wrapped], 1)
    return np.concatenate([position, rpy, velocity, omega], 1)


def commands(time: np.ndarray) -> np.ndarray:
    """`[M]` s to `[M, 2]` m/s and rad, distinct at all stamps."""
    return np.stack([3 + 0.5 * np.sin(time), 0.2 * np.cos(0.7 * time)], 1)


@dataclass
class Logged:
    """time: `[N]` irregular stamps; state: `[N, 12]` true states there; command: `[N, 2]`;
    position: `[N, 3]` and rotation: the poses as sensors see them."""

    time: np.ndarray
    state: np.ndarray
    command: np.ndarray
    position: np.ndarray
    rotation: Rotation


def logged(
    seconds: float = 20.0,
    rate: float = 50.0,
    noise: float = 0.0,
    start: float = 100.0,
    even: bool = False,
) -> Logged:
    """Stamps jitter by a third of their distance, and one in ten is dropped, unless they are even.

    noise: how many times `POSITION_NOISE` and `ANGLE_NOISE`.
    """
    rng = np.random.default_rng(0)
    count = int(seconds * rate)
    jitter = rng.uniform(-0.33, 0.33, count)
    time = start + (np.arange(count) + jitter) / rate
    dropped = rng.random(count) < 0.1
    dropped[[0, -1]] = False
    if even:
        time, dropped = start + np.arange(count) / rate, np.zeros(count, bool)
    time = time[~dropped]
    state = states(time)
    error = noise * rng.normal(size=(len(time), 6))
    turned = Rotation.from_rotvec(ANGLE_NOISE * error[:, 3:])
    return Logged(
        time=time,
        state=state,
        command=commands(time),
        position=state[:, :3] + POSITION_NOISE * error[:, :3],
        rotation=Rotation.from_euler("ZYX", state[:, 5:2:-1]) * turned,
    )


def terrain() -> terrain_map.TerrainMap:
    """Level ground of 60 m by 60 m below the drive."""
    return TerrainMap.from_array(np.full((61, 61), -1.0), np.full((8, 8), 3))


def errors(found: np.ndarray, time: np.ndarray) -> np.ndarray:
    """`[T, 12]` states less the true ones at `[T]` moments; angles wrapped."""
    error = found - states(time)
    error[:, 3:6] = (error[:, 3:6] + np.pi) % (2 * np.pi) - np.pi
    return error


def rms(error: np.ndarray) -> np.ndarray:
    """Root of the mean square of position, angles, velocity and angular velocity, each `[T, 3]`."""
    return np.sqrt((error**2).reshape(len(error), 4, 3).mean((0, 2)))
