"""Worlds to train on, worlds kept for tests, and the tasks on both: starts, headings and goals."""

import functools
import logging
import math
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax import kept, machine
from vertiwm_jax.config import AtLeastOne, ConfigError, Count, CountOrZero, NotNegative, settings
from vertiwm_jax.env.termination import edge_distance
from vertiwm_jax.errors import UserError
from vertiwm_jax.geometry import wrap
from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.terrain import files, obstacles, query, worlds
from vertiwm_jax.terrain.map import TerrainMap, stack
from vertiwm_jax.terrain.worlds import WorldConfig

_log = logging.getLogger(__name__)

Suite = Literal["easy", "hard", "obstacles"]
SUITES: dict[Suite, WorldConfig] = {
    "easy": WorldConfig(difficulties=("low", "mid")),
    "hard": WorldConfig(difficulties=("high",)),
    "obstacles": WorldConfig(difficulties=("low", "mid"), rocks=20, trees=2),
}
"""Procedural worlds to test on; Verti-Bench's have 10, 20 or 40 rocks and a tree for each ten."""
SMALLEST = 32.0
"""Least side of a map that holds tasks, m: starts on its circle then lie 1 m inside."""
_SURROUNDINGS = 4.0  # m
_SWAYS = 13  # places that a pair of the circle may turn to
# Of random tasks:
_DISTANCE = 20.0, 115.0  # m, least and largest from start to goal
_HEADING_ERROR = math.pi / 3  # rad, largest between the heading at the start and the goal
_STEEPEST = math.radians(20)  # of a start, under the wheels, and as a mean of its surroundings
_CLEARANCE = 1.0  # m that start and goal keep from obstacles
_MARGIN = 4.0  # m that they keep from the edge of the map
_CANDIDATES = 128  # drawn for each task; the first acceptable one is taken


class TaskError(UserError, ValueError):
    """No task can be found on the map, or a given one cannot be driven; the message says why."""


@struct.dataclass
class Tasks:
    """P tasks on W stacked worlds, in the coordinates of their map (see `TerrainMap.offset`).

    world: `[P]` int32.
    start: `[P, 2]` x, y, m.
    yaw: `[P]` rad.
    goal: `[P, 2]` x, y, m.
    """

    world: jax.Array
    start: jax.Array
    yaw: jax.Array
    goal: jax.Array

    def told(self, i: int, terrain: TerrainMap) -> str:
        """Task i on its map in words."""
        world, start, yaw, goal = (np.asarray(x)[i].tolist() for x in vars(self).values())
        told = f"task {i} has world {world}, start {start}, goal {goal}, yaw {yaw:g}"
        if terrain.middles:
            x, y = terrain.middles[min(max(world, 0), terrain.worlds - 1)]
            told += f", counted from the middle of the map, {x:.10g}, {y:.10g}"
        return told


@settings
class GroundConfig:
    """Where policies learn and where they are tested."""

    training: WorldConfig = WorldConfig(("mid", "high"), rocks=20, trees=2, obstructed=0.5)
    """Procedural worlds to train on, unless maps are given; low ones teach little."""
    train_worlds: Count = 180
    """Number of procedural worlds to train on."""
    suites: Annotated[tuple[Suite, ...], AtLeastOne] = ("easy", "hard", "obstacles")
    """Procedural worlds to test on, unless maps are given."""
    suite_worlds: Count = 6
    """Number of worlds of each suite."""
    held_out_every: CountOrZero = 5
    """Of given maps, every n-th is kept for testing. With 0, and of a single map, all are both
    trained and tested on."""
    starts: CountOrZero = 1024
    """Number of random tasks to train on, besides those across the circle of every world."""
    pairs: Count = 10
    """Number of tasks across the circle of each world."""
    sway: NotNegative = 0.25
    """Largest turn of such a task about the circle to a more level start, rad; none by 0."""
    obstacles: bool = False
    """Whether given maps keep their rocks and trees; the paper drives without them."""

    def check(self) -> None:
        if self.held_out_every == 1:
            raise ValueError("held_out_every: expected 0, or 2 and more to train on some, found 1")

    @property
    def world_suites(self) -> list[Suite]:
        """The suite of each world that `suite_worlds` draws."""
        return [name for name in SUITES if name in self.suites for _ in range(self.suite_worlds)]


def grounds(
    config: GroundConfig, path: Path | None, key: jax.Array, scale: float = 1.0
) -> tuple[TerrainMap, TerrainMap]:
    """The worlds to train on and those held out: maps at `path`, or procedural worlds.

    path, scale: see `files.load_map`. Too few maps to hold any out raise `ValueError`.
    """
    if path is None:
        keys = jax.random.split(jax.random.split(key)[0], config.train_worlds)
        training = worlds.generate(keys, config.training, scale)
        return training, suite_worlds(config, key, scale)
    terrain = files.load_map(path, scale=scale, obstacles=config.obstacles)
    if terrain.worlds == 1 or not config.held_out_every:
        _log.info("training and testing on the same %d map(s)", terrain.worlds)
        return terrain, terrain
    if terrain.worlds < config.held_out_every:
        raise ConfigError(
            f"{path}: held_out_every: expected at most the {terrain.worlds} worlds found, "
            f"is {config.held_out_every}"
        )
    number = np.arange(terrain.worlds)
    held_out = number % config.held_out_every == config.held_out_every - 1
    return terrain.subset(~held_out), terrain.subset(held_out)


def suite_worlds(config: GroundConfig, key: jax.Array, scale: float = 1.0) -> TerrainMap:
    """Worlds of the configured suites that `grounds` holds out, by the same key.

    Those of a suite do not depend on which others are configured. scale: as `worlds.generate`.
    """
    drawn, test_key = [], jax.random.split(key)[1]
    for number, (name, worlds_of) in enumerate(SUITES.items()):
        if name in config.suites:
            keys = jax.random.split(jax.random.fold_in(test_key, number), config.suite_worlds)
            drawn.append(worlds.generate(keys, worlds_of, scale))
    return stack(drawn)


def training_tasks(
    config: GroundConfig, terrain: TerrainMap, vehicle: Vehicle, key: jax.Array
) -> Tasks:
    """Random tasks and those across the circle of every world."""
    parts = (random_tasks(key, terrain, config.starts, vehicle), test_tasks(config, terrain))
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def test_tasks(config: GroundConfig, terrain: TerrainMap) -> Tasks:
    """Tasks across the circle of every world, 60 m in radius where the map is large enough."""
    half = float(terrain.size.min()) / 2
    radius = min(worlds.START_RADIUS, 15 / 16 * half)
    return circle_tasks(terrain, radius, config.pairs, config.sway)


def circle_tasks(
    terrain: TerrainMap, radius: float = 60.0, pairs: int = 10, sway: float = 0.0
) -> Tasks:
    """Verti-Bench's geometry: W x `pairs` tasks across a circle, world after world.

    Starts are evenly spaced on a circle about the middle of the map. Each goal lies opposite its
    start, and the vehicle heads for it. With `sway`, each pair turns by up to that many rad about
    the circle to the most level start: on rough ground a vehicle often cannot leave a start at a
    fixed place. `ValueError` if the circle does not fit on the map.
    """
    half = np.asarray(terrain.size) / 2
    if radius >= half.min():
        raise TaskError(
            f"circle_tasks: radius {radius:g} m does not fit on a map of "
            f"{2 * half[0]:g} x {2 * half[1]:g} m; choose one below {half.min():g} m"
        )
    return _across(terrain, half * np.array([1, -1]), radius, pairs, sway)


@functools.partial(kept.jit, static_argnames=("radius", "pairs", "sway"))
def _across(terrain: TerrainMap, half: jax.Array, radius: float, pairs: int, sway: float) -> Tasks:
    """Tasks across circles about the places that lie `half` m from the corners of all worlds."""
    middle = terrain.origin + half
    evenly = 2 * jnp.pi * jnp.arange(pairs) / pairs
    offsets = sway * jnp.linspace(-1, 1, _SWAYS)
    turns = evenly[:, None] + offsets

    def on_circle(angle: jax.Array) -> jax.Array:
        return middle + radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)

    def most_level(world: jax.Array) -> jax.Array:
        slopes = slope_around(terrain.select(world), on_circle(turns))
        slopes = slopes + 1e-3 * jnp.abs(offsets)  # level ground turns nothing
        return jnp.take_along_axis(turns, jnp.argmin(slopes, axis=1)[:, None], axis=1)[:, 0]

    world = jnp.arange(terrain.worlds, dtype=jnp.int32)
    angle = jax.vmap(most_level)(world).ravel() if sway else jnp.tile(evenly, terrain.worlds)
    start = on_circle(angle)
    return Tasks(
        world=jnp.repeat(world, pairs),
        start=start,
        yaw=wrap(angle + jnp.pi),
        goal=2 * middle - start,
    )


def slope_around(terrain: TerrainMap, xy: jax.Array) -> jax.Array:
    """Root mean square slope `[...]`, rad, of the ground within 4 m of points `[..., 2]`."""
    side = jnp.linspace(-_SURROUNDINGS, _SURROUNDINGS, 7)
    grid = jnp.stack(jnp.meshgrid(side, side), axis=-1).reshape(-1, 2)
    gradient = query.surface(terrain, xy[..., None, :] + grid).gradient
    return jnp.arctan(jnp.sqrt(jnp.mean(jnp.sum(gradient**2, axis=-1), axis=-1)))


def random_tasks(key: jax.Array, terrain: TerrainMap, count: int, vehicle: Vehicle) -> Tasks:
    """`count` random tasks, spread evenly over the worlds.

    Starts are level enough to leave, and goals lie roughly ahead, 20 to 115 m away. `ValueError` if
    no candidate was acceptable for some task.
    """
    tasks, found = _draw(key, terrain, count, vehicle)
    missing = int(count - found.sum())
    if missing:
        worlds = np.unique(np.asarray(tasks.world)[~np.asarray(found)])
        raise TaskError(
            f"random_tasks: no acceptable start and goal among {_CANDIDATES} candidates "
            f"for {missing} of {count} tasks, on worlds {worlds[:8].tolist()}: each is to lie "
            f"{_MARGIN:g} m inside the map, {_DISTANCE[0]:g} m and more from the other, clear of "
            f"obstacles, and the start on ground of at most {math.degrees(_STEEPEST):.0f} deg"
        )
    return tasks


@functools.partial(kept.jit, static_argnames="count")
def _draw(
    key: jax.Array, terrain: TerrainMap, count: int, vehicle: Vehicle
) -> tuple[Tasks, jax.Array]:
    low, high = terrain.extent
    bounds = low + _MARGIN, high - _MARGIN
    size = vehicle.length + 2 * _CLEARANCE, vehicle.width + 2 * _CLEARANCE

    def draw(inputs: tuple[jax.Array, jax.Array]) -> tuple[Tasks, jax.Array]:
        key, world = inputs
        selected = terrain.select(world)
        key_start, key_goal, key_yaw = jax.random.split(key, 3)
        shape = _CANDIDATES, 2
        start = jax.random.uniform(key_start, shape, jnp.float32, *bounds)
        goal = jax.random.uniform(key_goal, shape, jnp.float32, *bounds)
        offset = goal - start
        error = jax.random.uniform(
            key_yaw, shape[:1], minval=-_HEADING_ERROR, maxval=_HEADING_ERROR
        )
        yaw = jnp.arctan2(offset[:, 1], offset[:, 0]) + error
        distance = jnp.linalg.norm(offset, axis=-1)
        near_enough = (distance >= _DISTANCE[0]) & (distance <= _DISTANCE[1])

        def is_acceptable(i: jax.Array) -> jax.Array:
            roll, pitch, _ = place(selected, start[i], yaw[i], vehicle=vehicle).rpy
            tilt = jnp.arccos(jnp.cos(roll) * jnp.cos(pitch))
            level = slope_around(selected, start[i]) <= _STEEPEST
            ends = jnp.stack([start[i], goal[i]])
            blocked = obstacles.collides(selected, ends, yaw[i][None], *size)
            return near_enough[i] & (tilt <= _STEEPEST) & level & ~jnp.any(blocked)

        first = jax.lax.while_loop(
            lambda i: (i < _CANDIDATES) & ~is_acceptable(i), lambda i: i + 1, jnp.int32(0)
        )
        return Tasks(world, start[first], yaw[first], goal[first]), first < _CANDIDATES

    world = jnp.arange(count, dtype=jnp.int32) % terrain.worlds
    # In batches, small ones on CPUs, since each goes on until the last task of it is found.
    together = machine.together(cpu=16, accelerator=1024)
    return jax.lax.map(draw, (jax.random.split(key, count), world), batch_size=together)


_edge_distance = jax.jit(edge_distance)


def validate(tasks: Tasks, terrain: TerrainMap, goal_radius: float, margin: float) -> None:
    """`ValueError` names the first task that cannot be driven.

    Starts must lie `margin` m inside the map and farther than `goal_radius` m from the goal.
    """
    world = np.asarray(tasks.world)
    start_edge, goal_edge = (_edge_distance(terrain, xy) for xy in (tasks.start, tasks.goal))
    distance = np.linalg.norm(np.asarray(tasks.goal - tasks.start), axis=-1)
    # Negated, so that NaN fails.
    checks = {
        f"world: expected 0 to {terrain.worlds - 1}": ~((world >= 0) & (world < terrain.worlds)),
        f"start: expected at least {margin:g} m inside the map": ~(start_edge >= margin),
        "goal: expected inside the map": ~(goal_edge >= 0),
        f"goal: expected farther than {goal_radius:g} m from the start": ~(distance > goal_radius),
        "yaw: expected a finite angle": ~np.isfinite(np.asarray(tasks.yaw)),
    }
    for message, bad in checks.items():
        if bad.any():
            raise TaskError(f"tasks.{message}; {tasks.told(int(np.argmax(bad)), terrain)}")
