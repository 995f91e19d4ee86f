import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import GRASS, ground, hills, task

from vertiwm_jax.env import suites
from vertiwm_jax.env.termination import edge_distance
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain import obstacles
from vertiwm_jax.terrain.map import TerrainMap


def test_circle_is_verti_bench():
    pool = suites.circle_tasks(terrain_map.stack([ground(), ground()]))
    assert pool.world.tolist() == [0] * 10 + [1] * 10
    np.testing.assert_allclose(np.linalg.norm(pool.start, axis=-1), 60, rtol=1e-6)
    np.testing.assert_allclose(pool.goal, -pool.start, atol=1e-5)
    heading = np.stack([np.cos(pool.yaw), np.sin(pool.yaw)], axis=-1)
    np.testing.assert_allclose(heading, (pool.goal - pool.start) / 120, atol=1e-5)


def test_circle_must_fit():
    with pytest.raises(ValueError, match="radius 70 m does not fit on a map of 128 x 128 m"):
        suites.circle_tasks(ground(), radius=70)


def test_slope_around_a_plane_is_its_own():
    x = np.arange(129.0)
    plane = ground(0.06 * x + 0.05 * x[:, None]).select(0)
    points = jnp.array([[0.0, 0.0], [20.3, -31.7]])
    np.testing.assert_allclose(
        suites.slope_around(plane, points), np.arctan(np.hypot(0.06, 0.05)), rtol=1e-3
    )


def test_sway_turns_starts_to_level_ground():
    # Rough but for the quadrant north-east of the middle; south-east in the second world.
    rough = 1 + np.sin(np.add.outer(np.arange(129.0), np.arange(129.0)))
    rough[:64, 65:] = 1
    terrain = terrain_map.stack([ground(rough), ground(rough[::-1].copy())])
    still, swayed = (suites.circle_tasks(terrain, pairs=4, sway=s) for s in (0.0, np.pi / 4))
    np.testing.assert_allclose(np.linalg.norm(swayed.start, axis=-1), 60, rtol=1e-6)
    np.testing.assert_allclose(swayed.goal, -swayed.start, atol=1e-5)
    heading = np.stack([np.cos(swayed.yaw), np.sin(swayed.yaw)], axis=-1)
    np.testing.assert_allclose(heading, (swayed.goal - swayed.start) / 120, atol=1e-5)
    turned = np.asarray(still.start * swayed.start).sum(-1) / 60**2
    assert turned.min() >= np.cos(np.pi / 4) - 1e-5
    # East, north, west, south: two of them reach the level quadrant of their world.
    slopes = [
        np.asarray(suites.slope_around(terrain.select(world), swayed.start[4 * world :][:4]))
        for world in (0, 1)
    ]
    assert (slopes[0] < 0.01).tolist() == [True, True, False, False]
    assert (slopes[1] < 0.01).tolist() == [True, False, False, True]


@pytest.mark.integration
def test_random_tasks_are_acceptable_and_varied():
    relief = hills(height=2.5)
    blocks = np.array([[x, y, 6, 6, 3] for x in (-30, 0, 30) for y in (-30, 0, 30)])
    terrain = terrain_map.stack([ground(relief, blocks), ground(relief.T.copy(), blocks)])
    pool = suites.random_tasks(jax.random.key(0), terrain, 200, load_vehicle())
    assert np.bincount(pool.world).tolist() == [100, 100]
    offset = np.asarray(pool.goal - pool.start)
    distance = np.linalg.norm(offset, axis=-1)
    assert distance.min() >= 20 and distance.max() <= 115 and distance.std() > 10
    error = np.asarray(pool.yaw) - np.arctan2(offset[:, 1], offset[:, 0])
    assert np.abs((error + np.pi) % (2 * np.pi) - np.pi).max() <= np.pi / 3 + 1e-5
    for xy in (pool.start, pool.goal):
        assert edge_distance(terrain, xy).min() >= 4.0
        size = load_vehicle().length + 2, load_vehicle().width + 2
        assert not obstacles.collides(terrain, xy, pool.yaw, *size).any()
    # The slope of the plane under the wheels, from heights read with NumPy.
    for world in (0, 1):
        x, y = np.asarray(pool.start)[np.asarray(pool.world) == world].T
        dy, dx = np.gradient(np.asarray(terrain.elevation[world]))
        row, column = (64 - y).round().astype(int), (64 + x).round().astype(int)
        slope = np.hypot(dx[row, column], dy[row, column])
        assert slope.max() < np.tan(0.35) + 0.1
        around = [
            (dx**2 + dy**2)[r - 4 : r + 5, c - 4 : c + 5].mean()
            for r, c in zip(row, column, strict=True)
        ]
        assert np.sqrt(max(around)) < np.tan(0.35) + 0.05


def test_impossible_random_tasks_say_why():
    with pytest.raises(ValueError, match=r"for 3 of 3 tasks, on worlds \[0\]"):
        small = TerrainMap.from_array(np.zeros((17, 17)), np.full((2, 2), GRASS))
        suites.random_tasks(jax.random.key(0), small, 3, load_vehicle())


@pytest.mark.parametrize(
    ("pool", "message"),
    [
        (task((0, 0), (5, 0)), "goal: expected farther than 8 m"),
        (task((63.5, 0), (0, 0)), "start: expected at least 1 m inside"),
        (task((0, 0), (90, 0)), "goal: expected inside the map"),
        (task((jnp.nan, 0), (30, 0)), "start"),
        (task((0, 0), (30, 0), jnp.inf), "yaw"),
        (task((0, 0), (30, 0)).replace(world=jnp.array([1])), "world: expected 0 to 0"),
    ],
)
def test_bad_tasks_are_named(pool, message):
    with pytest.raises(ValueError, match=message):
        suites.validate(pool, ground(), 8.0, 1.0)


def test_edge_distance():
    points = jnp.array([[0.0, 0.0], [60.0, 10.0], [10.0, -63.0], [-65.0, 0.0], [0.0, 70.0]])
    np.testing.assert_allclose(edge_distance(ground(), points), [64, 4, 1, -1, -6], atol=1e-5)
