"""Worlds to train on, worlds kept for tests, and the tasks on both."""

import logging
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.config import AtLeastOne, ConfigError, Count, CountOrZero, NotNegative, settings
from vertiwm_jax.env.tasks import Tasks, circle_tasks, random_tasks
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.terrain import files, worlds
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
    return circle_tasks(
        terrain, min(worlds.START_RADIUS, 15 / 16 * half), config.pairs, config.sway
    )
