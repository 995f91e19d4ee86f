"""Ground that lies far from the origin of its coordinates is driven on like any, or is refused."""

import jax
import numpy as np
import pytest
from env.worlds import GRASS, bicycle_env, hills
from importers.bags import Bag

from vertiwm_jax.env.controllers import StraightToGoal
from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.suites import circle_tasks
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.importers import grid_map
from vertiwm_jax.importers.settings import Frames, GridMapSettings
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import MapError, TerrainMap

SIZE = 65
HEIGHTS = hills(SIZE, height=0.3)
NEAR, FAR = (0.0, 0.0), (512345.0, 5234567.0)
"""x, y, m, of the north-western vertex; far are those of UTM."""


def built(folder, origin):
    return TerrainMap.from_array(HEIGHTS, np.full((8, 8), GRASS), origin=origin)


def saved(folder, origin):
    files.save(built(folder, origin), folder / "map.npz")
    return files.load_map(folder / "map.npz")


def of_a_bag(folder, origin):
    """Rows of a GridMap go south to north by x, and columns by y."""
    half = (SIZE - 1) / 2
    centre = np.array(origin) + [half, -half]
    with Bag(folder / "bag") as bag:
        bag.grid_map(1.0, {"elevation": HEIGHTS.T[::-1]}, centre, 1.0)
    return grid_map.terrain([folder / "bag"], GridMapSettings("/map"), Frames())[0]


def driven(terrain):
    """Where vehicles are, seen from their goals, and how their episodes end."""
    config = NavigationConfig(horizon_seconds=20.0)
    env, params = bicycle_env(terrain, circle_tasks(terrain, 20.0, pairs=2), config)
    found = run_episodes(env, params, StraightToGoal(config, speed=2.0), jax.random.key(0))
    return np.asarray(found.position - found.goal[:, None]), np.asarray(found.success)


@pytest.fixture(scope="module")
def near():
    return driven(built(None, NEAR))


def test_ground_nearby_is_driven_on(near):
    assert near[1].all()


@pytest.mark.parametrize("make", [built, saved, of_a_bag])
def test_ground_too_far_away_is_refused(tmp_path, make):
    with pytest.raises(MapError, match=r"origin: .* less than 100 km, found .* on the map"):
        make(tmp_path, FAR)


@pytest.mark.parametrize("make", [built, saved, of_a_bag])
def test_ground_farther_away_is_driven_on_like_any(near, tmp_path, make):
    np.testing.assert_allclose(driven(make(tmp_path, (8192.0, -4096.0)))[0], near[0], atol=0.05)
