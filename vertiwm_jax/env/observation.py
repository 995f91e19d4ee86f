"""What a driving policy sees: motion, the goal in the vehicle's frame, and the ground near by.

Nothing is in world coordinates, so a policy cannot learn a map by heart, and moving or turning
the world with the vehicle leaves the observation as it is.
"""

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.env.termination import edge_distance
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain import obstacles, query
from vertiwm_jax.terrain.map import TerrainMap

# A fan of points in the yaw frame (x forward, y left, m): dense near the wheels, where tilt is
# decided, and wider and coarser with distance, where the way round a hill is.
_STATIONS = np.array([-3.0, -1.5, 0.0, 1.5, 3.0, 4.5, 6.5, 9.0, 12.0, 16.0, 21.0])
_LANES = 1.1 * np.arange(-4, 5)
_SPREAD = 1 + np.maximum(_STATIONS, 0) / 10
_FAN = np.stack(
    [np.broadcast_to(_STATIONS[:, None], (11, 9)), _SPREAD[:, None] * _LANES], axis=-1
).astype(np.float32)
_POINTS = _FAN.reshape(-1, 2)
_CLASSES = np.arange(99).reshape(11, 9)[2::2, ::4].ravel()  # of the points

_ANGLE_SCALE = 0.5  # rad
_SPEED_SCALE = 5.0  # m/s
_DISTANCE_SCALE = 50.0  # m
_HEIGHT_SCALE = 2.0  # m
_SINKAGE_SCALE = 0.1  # m

GOAL = slice(8, 11)
"""Where the observation holds the distance over 50 m and the cosine and sine of the bearing."""
OBSERVATION_SIZE = 13 + 3 * len(_POINTS) + 2 * len(_CLASSES)
OBSERVATION_LIMIT = 10.0
"""Every entry is clipped to this size."""


def distance_and_bearing(position: jax.Array, goal: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`[..., 3]` points to the distance `[...]` and the horizontal unit vector `[..., 2]`."""
    offset = goal - position
    # The maximum keeps the derivative finite at the goal itself.
    distance = jnp.sqrt(jnp.maximum(jnp.sum(offset**2, axis=-1), 1e-12))
    level = jnp.sqrt(jnp.maximum(jnp.sum(offset[..., :2] ** 2, axis=-1), 1e-12))
    return distance, offset[..., :2] / level[..., None]


def plate_sinkage(terrain: TerrainMap) -> jax.Array:
    """`[K]` m that a 0.25 m wide plate sinks under 50 kPa in each class, 0 on rigid ground.

    Bekker: p = (kc / b + kphi) z^n. One number that orders soils by how soft they are.
    """
    soils = terrain.soils
    stiffness = jnp.maximum(soils.kc / 0.25 + soils.kphi, 1.0)
    return jnp.where(terrain.deformable, (50e3 / stiffness) ** (1 / soils.n), 0.0)


def observe(
    terrain: TerrainMap, state: VehicleState, goal: jax.Array, action: jax.Array
) -> jax.Array:
    """`[OBSERVATION_SIZE]` float32 seen by one vehicle on the selected world.

    In order: roll, pitch; v_body; omega_body; distance to the goal, cosine and sine of its
    bearing; the last action; on a fan of points that reaches 21 m ahead, heights of ground and
    obstacles relative to the vehicle, slopes of the ground ahead and to the left; on a coarser
    fan friction and plate sinkage, -1 off the map.

    goal: `[3]` m; action: `[2]` in [-1, 1].
    """
    yaw = state.rpy[2]
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)

    distance, (east, north) = distance_and_bearing(state.position, goal)
    motion = (
        state.rpy[:2] / _ANGLE_SCALE,
        state.velocity / _SPEED_SCALE,
        state.angular_velocity,
        distance[None] / _DISTANCE_SCALE,
        jnp.stack([cos * east + sin * north, cos * north - sin * east]),
        action,
    )

    # Written out: a matmul may round map coordinates to ten bits on an accelerator.
    x, y = _POINTS[:, 0], _POINTS[:, 1]
    xy = state.position[:2] + jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    ground = query.surface(terrain, xy)
    heights = ground.height + obstacles.height_above_ground(terrain, xy) - state.position[2]
    # Slopes too: far away they are small differences of large heights, which a network that is
    # fed normalised heights alone is slow to make out.
    slope_x, slope_y = ground.gradient[:, 0], ground.gradient[:, 1]
    ahead, left = cos * slope_x + sin * slope_y, cos * slope_y - sin * slope_x

    sinkage = plate_sinkage(terrain)[ground.semantic[_CLASSES]] / _SINKAGE_SCALE
    classes = jnp.stack([ground.friction[_CLASSES], sinkage], axis=-1)
    on_map = edge_distance(terrain, xy[_CLASSES]) >= 0
    classes = jnp.where(on_map[:, None], classes, -1.0)

    observation = jnp.concatenate([*motion, heights / _HEIGHT_SCALE, ahead, left, classes.ravel()])
    return jnp.clip(observation, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)
