from dataclasses import replace

import jax
import numpy as np
import pytest

from vertiwm_jax.env import suites
from vertiwm_jax.env.suites import GroundConfig
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.rl.experiment import TaskConfig
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain.map import TerrainMap

GRASS = 3
CONFIG = GroundConfig(train_worlds=3, suite_worlds=2, starts=6, pairs=4)


def plane(slope_deg: float, size: int = 17) -> terrain_map.TerrainMap:
    """A plane that rises eastwards."""
    rise = np.tan(np.radians(slope_deg)) * np.arange(float(size))
    return TerrainMap.from_array(np.broadcast_to(rise, (size, size)), np.full((2, 2), GRASS))


@pytest.fixture(scope="module")
def procedural():
    return suites.grounds(CONFIG, None, jax.random.key(0))


def test_procedural_worlds_are_never_both_trained_and_tested_on(procedural):
    train, held_out = (np.asarray(terrain.elevation) for terrain in procedural)
    assert train.shape == (3, 129, 129) and held_out.shape == (6, 129, 129)
    assert not any(np.allclose(a, b) for a in train for b in held_out)


def test_worlds_of_a_suite_are_as_it_says(procedural):
    _, held_out = procedural
    assert CONFIG.world_suites == ["easy"] * 2 + ["hard"] * 2 + ["obstacles"] * 2
    heights = np.asarray(held_out.elevation) / float(held_out.resolution)
    slopes = np.hypot(np.diff(heights, axis=1)[..., 1:], np.diff(heights, axis=2)[:, 1:])
    easy, hard, obstacles = np.degrees(np.arctan(np.median(slopes, axis=(1, 2)))).reshape(3, 2)
    assert max(*easy, *obstacles) < 14 < min(hard)
    rocks = (np.asarray(held_out.obstacles[..., 4]) > 0).any(axis=1)
    assert rocks.tolist() == [False] * 4 + [True] * 2


def test_a_suite_alone_has_the_same_worlds(procedural):
    alone = replace(CONFIG, suites=("obstacles",))
    _, terrain = suites.grounds(alone, None, jax.random.key(0))
    np.testing.assert_array_equal(terrain.elevation, procedural[1].elevation[4:])
    np.testing.assert_array_equal(terrain.obstacles, procedural[1].obstacles[4:])
    with pytest.raises(ValueError, match="suites: expected at least one of easy, hard, obstacles"):
        replace(CONFIG, suites=())


@pytest.mark.parametrize(("count", "every"), [(1, 5), (3, 0)])
def test_one_map_or_all_are_tested_on_where_trained(tmp_path, count, every):
    for i in range(count):
        files.save(plane(float(i)), tmp_path / f"map_{i}.npz")
    config = replace(CONFIG, held_out_every=every)
    train, held_out = suites.grounds(config, tmp_path, jax.random.key(0))
    assert train.worlds == held_out.worlds == count
    with pytest.raises(ValueError, match="held_out_every: expected 0, or 2 and more"):
        replace(CONFIG, held_out_every=1)


def test_every_so_manieth_map_is_held_out(tmp_path):
    slopes = np.arange(7.0)
    for i, slope in enumerate(slopes):
        files.save(plane(slope), tmp_path / f"{i}.npz")
    config = replace(CONFIG, held_out_every=3)
    train, held_out = suites.grounds(config, tmp_path, jax.random.key(0))

    def found(terrain):
        rise = np.asarray(terrain.elevation[:, 0, 1] - terrain.elevation[:, 0, 0])
        return np.degrees(np.arctan(rise)).round(2).tolist()

    assert found(held_out) == [2, 5] and found(train) == [0, 1, 3, 4, 6]
    assert train.semantic.shape[0] == train.friction.shape[0] == train.obstacles.shape[0] == 5
    with pytest.raises(ValueError, match="expected at most the 7 worlds found, is 8"):
        suites.grounds(replace(config, held_out_every=8), tmp_path, jax.random.key(0))


def test_tasks_cross_every_world_and_start_anywhere(procedural):
    train, held_out = procedural
    across = suites.test_tasks(CONFIG, held_out)
    assert np.bincount(np.asarray(across.world)).tolist() == [4] * 6
    np.testing.assert_allclose(np.linalg.norm(across.start, axis=-1), 60, rtol=1e-5)
    np.testing.assert_allclose(across.goal, -np.asarray(across.start), atol=1e-3)
    tasks = suites.training_tasks(CONFIG, train, load_vehicle(), jax.random.key(1))
    assert tasks.start.shape == (6 + 3 * 4, 2)
    assert (np.abs(np.asarray(tasks.start)) < 64).all()
    small = suites.test_tasks(CONFIG, plane(0))
    np.testing.assert_allclose(np.linalg.norm(small.start, axis=-1), 7.5, rtol=1e-5)


def test_every_purpose_has_its_own_randomness():
    config = TaskConfig(seed=3)
    keys = [config.key(name) for name in ("worlds", "tasks", "training", "testing")]
    drawn = {int(jax.random.bits(part)) for key in keys for part in (key, *jax.random.split(key))}
    assert len(drawn) == 12
