"""The observation of a driving policy: motion, goal in the body frame, and ground nearby.

Nothing is in world coordinates. So a policy cannot memorize a map, and an observation does not
change when world and vehicle are moved or turned together.
"""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.env import route
from vertiwm_jax.env.route import Routes, footprint, places
from vertiwm_jax.env.termination import edge_distance
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.networks.policy import Candidates, ObservationLayout, tiles
from vertiwm_jax.perception.features import EMBEDDING_SHAPE
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain import obstacles, patches, query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.obstacles import Side

# Where the vehicle would stand on arcs of constant steering: as far as a choice made now reaches.
ARC_STEERING = np.linspace(-1.0, 1.0, 9)  # of the front wheels' largest angle
ARC_STATIONS = np.array([0.45, 0.9, 1.4, 2.0, 2.7, 3.5, 4.5, 6.0])  # wheelbases along an arc
_POSES = 1 + ARC_STEERING.size * ARC_STATIONS.size  # the first is where it stands now
CLASS_PLACES = 1 + np.arange(ARC_STEERING.size * ARC_STATIONS.size).reshape(9, 8)[::4, ::2].ravel()

_ANGLE_SCALE = 0.5  # rad
_SPEED_SCALE = 5.0  # m/s
_DISTANCE_SCALE = 50.0  # m
_HEIGHT_SCALE = 2.0  # m
ROUTE_SCALE = 10.0  # m
_SINKAGE_SCALE = 0.1  # m
WAITING_SCALE = 5.0  # s
_WALL = 1.5  # m, crown that stands for obstacles and the edge of the map

GOAL = slice(8, 11)
"""Place of the distance over 50 m and of the cosine and sine of the bearing."""
WAITING = slice(13, 15)
"""Place of the seconds stalled, and of those told to drive backwards, over `WAITING_SCALE`."""
GROUND = slice(15, 15 + 6 * _POSES)
"""Place of height, crown, rise, bank, twist and route, each of all places."""
OBSERVATION_SIZE = GROUND.stop + 2 * CLASS_PLACES.size
IMAGE_SHAPE = (*EMBEDDING_SHAPE[:2], EMBEDDING_SHAPE[2] + 1)
"""Of the ground as encoders see it, and of what must not be driven on, which they do not see."""
OBSERVATION_LIMIT = 10.0
"""Entries are clipped to this absolute value."""


@dataclass(frozen=True)
class Part:
    """A part of the observation: its place, its unit, and the value that 1 stands for."""

    where: slice
    unit: str
    scale: float


def _of_places(number: int, unit: str, scale: float) -> Part:
    first = GROUND.start + number * _POSES
    return Part(slice(first, first + _POSES), unit, scale)


LAYOUT = {
    "roll": Part(slice(0, 1), "rad", _ANGLE_SCALE),
    "pitch": Part(slice(1, 2), "rad", _ANGLE_SCALE),
    "velocity": Part(slice(2, 5), "m/s", _SPEED_SCALE),
    "angular velocity": Part(slice(5, 8), "rad/s", 1.0),
    "goal distance": Part(slice(8, 9), "m", _DISTANCE_SCALE),
    "goal bearing": Part(slice(9, 11), "cosine and sine", 1.0),
    "last action": Part(slice(11, 13), "speed and steering in [-1, 1]", 1.0),
    "stalled": Part(slice(13, 14), "s", WAITING_SCALE),
    "backing": Part(slice(14, 15), "s", WAITING_SCALE),
    "height": _of_places(0, "m", _HEIGHT_SCALE),
    "crown": _of_places(1, "m", route.CROWN_SCALE),
    "rise": _of_places(2, "m/m", route.SLOPE_SCALE),
    "bank": _of_places(3, "m/m", route.SLOPE_SCALE),
    "twist": _of_places(4, "m/m", route.TWIST_SCALE),
    "route": _of_places(5, "m", ROUTE_SCALE),
    "friction": Part(slice(GROUND.stop, OBSERVATION_SIZE, 2), "1", 1.0),
    "sinkage": Part(slice(GROUND.stop + 1, OBSERVATION_SIZE, 2), "m", _SINKAGE_SCALE),
}
"""The parts of the observation by name; -1 in the last two means off the map."""


@dataclass(frozen=True)
class ObservationSpec:
    """Which parts an observation has, static.

    arcs: whether it shows the ground along arcs ahead.
    image: whether it ends with the ground as encoders see it.
    """

    arcs: bool = True
    image: bool = False

    @property
    def parts(self) -> dict[str, Part]:
        """What an observation holds, by name, in order."""
        end = OBSERVATION_SIZE if self.arcs else GROUND.start
        parts = {name: part for name, part in LAYOUT.items() if part.where.start < end}
        if self.image:
            parts["embedding"] = Part(slice(end, end + math.prod(IMAGE_SHAPE)), "1", 1.0)
        return parts

    @property
    def size(self) -> int:
        """O, how many numbers an observation has."""
        return max(part.where.stop for part in self.parts.values())

    @property
    def layout(self) -> ObservationLayout:
        """How networks should read observations."""
        return ObservationLayout(ARCS if self.arcs else None, IMAGE_SHAPE if self.image else None)


def distance_and_bearing(position: jax.Array, goal: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distance `[...]` and horizontal unit vector `[..., 2]` to points `[..., 3]`."""
    offset = goal - position
    # The maximum keeps the derivative finite at the goal itself.
    distance = jnp.sqrt(jnp.maximum(jnp.sum(offset**2, axis=-1), 1e-12))
    level = jnp.sqrt(jnp.maximum(jnp.sum(offset[..., :2] ** 2, axis=-1), 1e-12))
    return distance, offset[..., :2] / level[..., None]


def plate_sinkage(terrain: TerrainMap) -> jax.Array:
    """`[K]` sinkage, m, of a plate 0.25 m wide under 50 kPa in each class; 0 on rigid ground.

    Bekker: p = (kc / b + kphi) z^n. This orders soils by softness.
    """
    soils = query.soils(terrain)
    stiffness = jnp.maximum(soils.kc / 0.25 + soils.kphi, 1.0)
    return jnp.where(terrain.deformable, (50e3 / stiffness) ** (1 / soils.n), 0.0)


def arcs_ahead(observation: jax.Array) -> tuple[jax.Array, ...]:
    """Height, crown, rise, bank, twist and route `[..., arcs, stations]`, scaled as observed."""
    shape = (*observation.shape[:-1], 6, _POSES)
    here_and_ahead = observation[..., GROUND].reshape(shape)
    ahead = here_and_ahead[..., 1:].reshape(*shape[:-1], ARC_STEERING.size, ARC_STATIONS.size)
    return tuple(jnp.moveaxis(ahead, -3, 0))


def _split(observation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The part of each arc `[..., 9, 49]`, including its steering, and the rest."""
    ahead = jnp.concatenate(arcs_ahead(observation), axis=-1)
    steering = jnp.broadcast_to(ARC_STEERING.astype(np.float32), ahead.shape[:-1])
    here = observation[..., GROUND][..., ::_POSES]
    rest = (observation[..., : GROUND.start], here, observation[..., GROUND.stop :])
    return jnp.concatenate([ahead, steering[..., None]], -1), jnp.concatenate(rest, -1)


ARCS = Candidates(_split, tuple((0.0, float(steering)) for steering in ARC_STEERING))
"""The arcs as candidates of a policy; each stands for its steering."""


def poses_ahead(vehicle: Vehicle) -> tuple[jax.Array, jax.Array]:
    """Poses on the arcs, in the yaw frame: x, y in m `[P, 2]` and heading in rad `[P]`."""
    distance = ARC_STATIONS * vehicle.wheelbase
    heading = vehicle.curvature(ARC_STEERING)[:, None] * distance
    # sinc is exact for the straight arc, where the radius is infinite.
    chord = distance * jnp.sinc(heading / (2 * jnp.pi))
    xy = jnp.stack([chord * jnp.cos(heading / 2), chord * jnp.sin(heading / 2)], axis=-1)
    return jnp.pad(xy.reshape(-1, 2), [(1, 0), (0, 0)]), jnp.pad(heading.ravel(), (1, 0))


def observe(
    spec: ObservationSpec,
    terrain: TerrainMap,
    vehicle: Vehicle,
    state: VehicleState,
    goal: jax.Array,
    routes: Routes,
    action: jax.Array,
    waiting: jax.Array,
    embedding: jax.Array | None = None,
) -> jax.Array:
    """`[O]` float32 seen by one vehicle on the selected world, in the parts of `ObservationSpec`.

    In order: roll, pitch; v_body; omega_body; distance to the goal, cosine and sine of its
    bearing; the last action; for how long the vehicle has stalled, and been told to drive
    backwards, without a break; `ground_ahead`; `image`.

    goal: `[3]` m; routes: to it; action: `[2]` in [-1, 1]; waiting: `[2]` s, stalled and backing;
    embedding: `EMBEDDING_SHAPE`, the ground as encoders see it, if the observation has that.
    """
    cos, sin = jnp.cos(state.rpy[2]), jnp.sin(state.rpy[2])
    distance, (east, north) = distance_and_bearing(state.position, goal)
    parts = [
        state.rpy[:2] / _ANGLE_SCALE,
        state.velocity / _SPEED_SCALE,
        state.angular_velocity,
        distance[None] / _DISTANCE_SCALE,
        jnp.stack([cos * east + sin * north, cos * north - sin * east]),
        action,
        waiting / WAITING_SCALE,
    ]
    if spec.arcs:
        parts += ground_ahead(terrain, vehicle, state, distance, routes)
    if spec.image:
        assert embedding is not None
        parts.append(image(terrain, state, embedding))
    return jnp.clip(jnp.concatenate(parts), -OBSERVATION_LIMIT, OBSERVATION_LIMIT)


def ground_ahead(
    terrain: TerrainMap, vehicle: Vehicle, state: VehicleState, distance: jax.Array, routes: Routes
) -> list[jax.Array]:
    """What the ground would do to the vehicle here and at places on arcs up to six wheelbases long.

    Mean height under the wheels against now; crown between them, which the belly meets, and a wall
    where an obstacle or the edge of the map would be hit; rise; bank; twist, which lifts wheels;
    route, by how much more the way to the goal costs from there than from here, and here by how
    much more than its distance `[]`, m; friction and plate sinkage at some of the places, -1 off
    the map.
    """
    yaw, (place, heading) = state.rpy[2], poses_ahead(vehicle)
    xy = _at(state, place)
    under = footprint(vehicle, query.height(terrain, _at(state, places(vehicle, place, heading))))
    size = vehicle.length + 2 * route.CLEARANCE, vehicle.width + 2 * route.CLEARANCE
    cost = routes.cost_to_go(terrain, xy)

    seen = _at(state, place[CLASS_PLACES])
    below = query.surface(terrain, seen)
    sinkage = plate_sinkage(terrain)[below.semantic] / _SINKAGE_SCALE
    classes = jnp.stack([below.friction, sinkage], axis=-1)
    classes = jnp.where((edge_distance(terrain, seen) >= 0)[:, None], classes, -1.0)
    return [
        (under.mean - state.position[2]) / _HEIGHT_SCALE,
        jnp.where(
            _blocked(terrain, xy, yaw + heading, *size), _WALL / route.CROWN_SCALE, under.crown
        ),
        under.rise,
        under.bank,
        under.twist,
        jnp.append(cost[0] - distance, cost[1:] - cost[0]) / ROUTE_SCALE,
        classes.ravel(),
    ]


def image(terrain: TerrainMap, state: VehicleState, embedding: jax.Array) -> jax.Array:
    """`IMAGE_SHAPE`, tile by tile, the order in which networks read it, as one vector.

    After the latents `EMBEDDING_SHAPE` comes a channel that is 1 where a cell touches an obstacle
    or lies off the map, and else 0.
    """
    side = patches.CELL_PIXELS * patches.PIXEL_METERS
    xy = _at(state, jnp.asarray(patches.CELLS_OF_PATCH.T))
    blocked = _blocked(terrain, xy, state.rpy[2], side, side).reshape(*IMAGE_SHAPE[:2], 1)
    # What a model sees where it has diverged may be anything.
    return tiles(jnp.concatenate([jnp.nan_to_num(embedding), blocked], axis=-1)).ravel()


def _at(state: VehicleState, points: jax.Array) -> jax.Array:
    """Points `[..., 2]`, m ahead and to the left of a vehicle, in the world."""
    # Written out: a matmul may round map coordinates to ten bits on an accelerator.
    cos, sin = jnp.cos(state.rpy[2]), jnp.sin(state.rpy[2])
    (x, y), (east, north) = jnp.moveaxis(points, -1, 0), state.position[:2]
    return jnp.stack([east + (cos * x - sin * y), north + (sin * x + cos * y)], axis=-1)


def _blocked(
    terrain: TerrainMap, xy: jax.Array, yaw: jax.Array, length: Side, width: Side
) -> jax.Array:
    """`[...]` bool, whether rectangles touch an obstacle, or their middle is off the map.

    Heights repeat beyond the edge of the map, which would look like the best of roads.
    """
    blocked = obstacles.collides(terrain, xy, yaw, length, width)
    return blocked | (edge_distance(terrain, xy) < 0)
