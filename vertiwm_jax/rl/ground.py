"""Which worlds to train on, which to keep for the test, and the tasks on both."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.env.chassis import Chassis
from vertiwm_jax.env.tasks import Tasks, circle_tasks, random_tasks
from vertiwm_jax.terrain import files, vertibench, worlds
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.worlds import MEDIAN_SLOPE_DEG, WorldConfig


@dataclass(frozen=True)
class GroundConfig:
    """Where policies learn and where they are tested."""

    training: WorldConfig = WorldConfig(difficulties=("mid", "high"))
    """Procedural worlds to train on, unless maps are given; low ones teach little."""
    testing: WorldConfig = WorldConfig()
    """Procedural worlds to test on."""
    train_worlds: int = 180
    """Procedural worlds to train on."""
    held_out_worlds: int = 18
    """Procedural worlds to test on."""
    held_out_every: int = 5
    """Of given maps, every so-manieth is not trained on but tested on."""
    starts: int = 4096
    """Random tasks to train on, beside those across the circle of every world."""
    pairs: int = 10
    """Tasks across the circle of a world."""
    sway: float = 0.25
    """How far, rad, each of them may turn to a more level start; 0 is Verti-Bench's circle."""
    obstacles: bool = False
    """Whether the rocks and trees of given maps stand there; without them as in the paper."""


def grounds(
    config: GroundConfig, path: Path | None, key: jax.Array
) -> tuple[TerrainMap, TerrainMap]:
    """The worlds to train on and those held out, from maps at `path` or else procedural.

    path: see `load`. Too few maps to hold any out raise `ValueError`.
    """
    if path is None:
        train_key, test_key = jax.random.split(key)
        return (
            worlds.generate(jax.random.split(train_key, config.train_worlds), config.training),
            worlds.generate(jax.random.split(test_key, config.held_out_worlds), config.testing),
        )
    terrain = load(config, path)
    if terrain.worlds < config.held_out_every:
        raise ValueError(
            f"{path}: held_out_every: expected at most the {terrain.worlds} worlds found, "
            f"is {config.held_out_every}"
        )
    number = np.arange(terrain.worlds)
    held_out = number % config.held_out_every == config.held_out_every - 1
    return _subset(terrain, ~held_out), _subset(terrain, held_out)


def load(config: GroundConfig, path: Path) -> TerrainMap:
    """The maps of a Verti-Bench checkout or of a folder of `.npz` maps; else `MapError`."""
    terrain = vertibench.load(path) if (path / "envs").is_dir() else files.load(path)
    return terrain if config.obstacles else replace(terrain, obstacles=terrain.obstacles[:, :0])


def training_tasks(
    config: GroundConfig, terrain: TerrainMap, chassis: Chassis, key: jax.Array
) -> Tasks:
    """Random tasks and those across the circle of every world."""
    parts = (random_tasks(key, terrain, config.starts, chassis), test_tasks(config, terrain))
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def test_tasks(config: GroundConfig, terrain: TerrainMap) -> Tasks:
    """Tasks across the circle of every world, 60 m in radius where the map is large enough."""
    cells = min(terrain.elevation.shape[-2:]) - 1
    half = cells * float(terrain.resolution) / 2
    return circle_tasks(
        terrain, min(worlds.START_RADIUS, 15 / 16 * half), config.pairs, config.sway
    )


def difficulties(terrain: TerrainMap) -> list[str]:
    """The preset of difficulty that each world's median slope is nearest to."""
    names = list(MEDIAN_SLOPE_DEG)
    presets = np.array(list(MEDIAN_SLOPE_DEG.values()))
    slopes = map(_median_slope_deg, np.asarray(terrain.elevation) / float(terrain.resolution))
    return [names[int(np.argmin(np.abs(presets - slope)))] for slope in slopes]


def _subset(terrain: TerrainMap, chosen: np.ndarray) -> TerrainMap:
    stacked = ("elevation", "semantic", "friction", "obstacles")
    return replace(terrain, **{name: getattr(terrain, name)[chosen] for name in stacked})


def _median_slope_deg(heights: np.ndarray) -> float:
    """Of the two triangles of each cell; `heights` in units of the resolution."""
    x, y = np.diff(heights, axis=1), np.diff(heights, axis=0)
    slopes = np.hypot((x[:-1], x[1:]), (y[:, :-1], y[:, 1:]))
    return math.degrees(math.atan(np.median(slopes)))
