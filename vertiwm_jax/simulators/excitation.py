"""Where recorded drives start and go to, and the paper's commands."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.env.termination import edge_distance
from vertiwm_jax.simulators.protocol import SimulatorError
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap

MARGIN = 3.0
"""m from the edge of the map at which a drive ends; starts and goals keep 2 m more."""
SMALLEST = 20.0
"""Least side of a map to record drives on, m: half of it is room for starts."""
_USUAL_SPEED = 2.5  # m/s, straight on for a whole drive is the room that a start should have
_CANDIDATES = 2000
_STEEPEST_START = np.tan(np.radians(20))
_BORDER_SHARE = (0.1, 0.9)  # of soil ahead of a start on mixed ground
_CLEARANCE = 8.0  # m from the middle of obstacles
_NEAREST_GOAL = 20.0  # m


def within(terrain: TerrainMap, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest x, y `[2]` that are `margin` m from the edge, m."""
    low, high = (np.asarray(corner, float) for corner in terrain.extent)
    return low + margin, high - margin


def start(rng: np.random.Generator, terrain: TerrainMap, seconds: float) -> tuple[float, ...]:
    """x, y, m, and yaw, rad, on the selected world: nowhere steep, and clear of obstacles.

    If there is such a place, with room ahead for the whole drive, and on mixed ground with a border
    of soil ahead. `SimulatorError` if there is none that is not steep.
    """
    low, high = within(terrain, MARGIN + 2)
    xy = rng.uniform(low, high, (_CANDIDATES, 2)).astype(np.float32)
    yaw = rng.uniform(-np.pi, np.pi, _CANDIDATES).astype(np.float32)
    ahead = np.arange(0.0, _USUAL_SPEED * seconds).astype(np.float32)
    slope, edge, soft = jax.device_get(_surroundings(terrain, xy, yaw, ahead))
    boxes = np.asarray(terrain.obstacles[terrain.world])
    boxes = boxes[boxes[:, 4] > 0]
    blocked = np.linalg.norm(xy[:, None] - boxes[:, :2], axis=-1) < _CLEARANCE
    good = (slope <= _STEEPEST_START) & ~blocked.any(axis=1)
    roomy = good & (edge > MARGIN + 2)
    crossing = roomy & (soft >= _BORDER_SHARE[0]) & (soft <= _BORDER_SHARE[1])
    soils = np.asarray(terrain.deformable[terrain.semantic[terrain.world]])
    mixed = soils.any() and not soils.all()
    for wanted in (crossing if mixed else roomy, roomy, good):
        if wanted.any():
            first = int(np.argmax(wanted))
            return (*xy[first].tolist(), float(yaw[first]))
    steepest = "20 degrees or less, away from obstacles"
    raise SimulatorError(
        f"world {int(terrain.world)}: expected a place to start of {steepest}, found none"
    )


def sinusoids(
    rng: np.random.Generator, steps: int, full_lock: float
) -> Callable[[np.ndarray], np.ndarray]:
    """The paper's commands: speed at 0.1 to 2.5 Hz between bounds that are drawn from 1 to 2 and 3
    to 4 m/s, steering at 0.1 to 0.5 Hz with an amplitude of 0.2 to 1 of `full_lock`, rad."""
    time = STEP_SECONDS * np.arange(steps)

    def wave(fastest: float) -> np.ndarray:
        frequency, phase = rng.uniform(0.1, fastest), rng.uniform(0, 2 * np.pi)
        return np.sin(2 * np.pi * frequency * time + phase)

    low, high = rng.uniform(1, 2), rng.uniform(3, 4)
    speed = (low + high) / 2 + (high - low) / 2 * wave(2.5)
    steering = full_lock * rng.uniform(0.2, 1.0) * wave(0.5)
    commands = iter(np.stack([speed, steering], axis=1))
    return lambda state: next(commands)


def next_goal(rng: np.random.Generator, terrain: TerrainMap, xy: np.ndarray) -> np.ndarray:
    """`[3]` m, on the ground of the selected world, anywhere on the map but near `[2]` xy."""
    places = rng.uniform(*within(terrain, MARGIN + 2), (64, 2)).astype(np.float32)
    distance = np.linalg.norm(places - xy, axis=-1)
    place = places[np.argmax(np.minimum(distance, _NEAREST_GOAL))]
    return np.append(place, np.asarray(query.height(terrain, jnp.asarray(place))))


@jax.jit
def _surroundings(
    terrain: TerrainMap, xy: jax.Array, yaw: jax.Array, ahead: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of places `[N]`: slope over 4 m; m from the edge at the end of the way straight ahead,
    given at `[S]` m; and the share of soil on it."""
    span = 2.0 * jnp.array([[1, 0], [-1, 0], [0, 1], [0, -1]], jnp.float32)
    east, west, north, south = jnp.moveaxis(query.height(terrain, xy[:, None] + span), -1, 0)
    slope = jnp.hypot(east - west, north - south) / 4.0
    heading = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
    way = xy[:, None] + ahead[:, None] * heading[:, None]
    soft = terrain.deformable[query.surface(terrain, way).semantic]
    return slope, edge_distance(terrain, way[:, -1]), jnp.mean(soft, axis=-1)
