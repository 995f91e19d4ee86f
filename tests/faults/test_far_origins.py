"""Ground that lies far from the origin of its coordinates is driven on like any."""

import csv
from dataclasses import replace

import jax
import numpy as np
import pytest
from doors import door
from env.worlds import GRASS, bicycle_env, hills
from importers.bags import Bag
from importers.logged import SETTINGS, logged

from vertiwm_jax import config
from vertiwm_jax.env.controllers import StraightToGoal
from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.suites import circle_tasks
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.importers import grid_map
from vertiwm_jax.importers.settings import Frames, GridMapSettings, Table
from vertiwm_jax.learning import dataset
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


@pytest.mark.parametrize("origin", [(8192.0, -4096.0), FAR, (-2e7, 6378137.25)])
@pytest.mark.parametrize("make", [built, saved, of_a_bag])
def test_ground_far_away_is_driven_on_like_any(near, tmp_path, make, origin):
    np.testing.assert_allclose(driven(make(tmp_path, origin))[0], near[0], atol=0.01)


@pytest.mark.parametrize("origin", [(1e9, 0.0), (0.0, np.inf), (0.0, np.nan)])
def test_ground_that_is_nowhere_is_refused(origin):
    with pytest.raises(MapError, match=r"map: origin: expected finite x, y in m, found"):
        built(None, origin)


def test_what_is_driven_is_told_as_in_the_file(tmp_path):
    maps, folder = tmp_path / "maps", tmp_path / "drives"
    maps.mkdir()
    saved(maps, FAR)
    arguments = ["--output", folder, "--terrain", maps, "--drives", 3, "--seconds", 1]
    door("collect")([str(word) for word in arguments])
    with np.load(folder / "world_000.npz") as file:
        state = file["state"]
    west, north = FAR
    assert state.dtype == np.float64
    assert (state[..., 0] > west).all() and (state[..., 0] < west + SIZE).all()
    assert (state[..., 1] < north).all() and (state[..., 1] > north - SIZE).all()
    np.testing.assert_allclose(np.load(folder / "maps/world_000.npz")["origin"], FAR)
    drives, terrain = dataset.load_file(folder / "world_000.npz")
    np.testing.assert_allclose(drives.state[..., :2] + terrain.offset(), state[..., :2], atol=1e-5)

    words = ["navigation", "--policy", "straight", "--terrain", maps, "--pairs", 2]
    door("evaluate")([*map(str, words), "--output", str(tmp_path / "out")])
    with (tmp_path / "out" / "episodes.csv").open() as file:
        goals = [(float(row["goal_x"]), float(row["goal_y"])) for row in csv.DictReader(file)]
    middle = np.array(FAR) + [SIZE // 2, -(SIZE // 2)]
    radius = np.linalg.norm(np.array(goals) - middle, axis=1)
    np.testing.assert_allclose(radius, 15 / 16 * (SIZE // 2), atol=0.01)


def test_a_log_is_imported_where_its_map_is(tmp_path):
    seen = logged(seconds=12.0)
    table = Table("t", ("x", "y", "z"), "speed", "steer", quaternion=("qx", "qy", "qz", "qw"))
    config.save(replace(SETTINGS, table=table), tmp_path / "settings.yaml")
    states = {}
    for name, (x, y) in {"near": NEAR, "far": FAR}.items():
        log = [seen.time, *(seen.position + [x, y, 0]).T, *seen.rotation.as_quat().T]
        rows = np.stack([*log, *seen.command.T], axis=1)
        header = "t,x,y,z,qx,qy,qz,qw,speed,steer"
        np.savetxt(tmp_path / f"{name}.csv", rows, "%.17g", ",", header=header, comments="")
        level = TerrainMap.from_array(np.zeros((101, 201)), origin=(x - 100, y + 50))
        files.save(level, tmp_path / f"{name}.npz")
        words = [tmp_path / f"{name}.csv", "--settings", tmp_path / "settings.yaml"]
        words += ["--map", tmp_path / f"{name}.npz", "--output", tmp_path / name]
        door("import_drives")([str(word) for word in words])
        with np.load(tmp_path / name / "drives.npz") as file:
            states[name] = np.asarray(file["state"], float) - [x, y, *np.zeros(10)]
        (drives, terrain) = dataset.load_file(tmp_path / name / "drives.npz")
        at = drives.state[..., :2] + terrain.offset() - [x, y]
        np.testing.assert_allclose(at, states[name][..., :2], atol=1e-5)
    np.testing.assert_allclose(states["far"], states["near"], atol=1e-5)
