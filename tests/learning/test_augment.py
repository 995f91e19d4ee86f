from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax import geometry
from vertiwm_jax.dynamics import rollout, warm_up
from vertiwm_jax.learning import augment, dataset
from vertiwm_jax.learning.windows import Windows, gather, index
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain import obstacles, patches, query
from vertiwm_jax.terrain.map import MapError, TerrainMap

DRIVES = Path(__file__).parents[1] / "data" / "chrono_drives"
C = 4


def world(seed, **changes):
    """Rough ground of all classes that is not centred, with two obstacles and an unused row."""
    rng = np.random.default_rng(seed)
    boxes = np.array([[3, -2, 4, 1, 2.0], [7, 5, 1, 2, 3.0], [0, 0, 0, 0, 0]])
    arguments = {
        "elevation": rng.uniform(0, 8, (17, 17)),
        "classes": rng.integers(0, 10, (4, 4)),
        "friction": rng.uniform(0.2, 0.9, (4, 4)),
        "obstacles": boxes,
        "origin": (-1.0, 10.0),
        **changes,
    }
    return TerrainMap.from_array(**arguments)


@pytest.fixture(scope="module")
def both():
    return augment.with_mirrored(terrain_map.stack([world(0), world(1)]))


def points(count=500):
    return np.random.default_rng(3).uniform([-1, -6], [15, 10], (count, 2)).astype(np.float32)


def across(xy):
    """The mirror image of points: the centre of the map is (7, 2)."""
    return np.stack([7 + (xy[..., 1] - 2), 2 + (xy[..., 0] - 7)], axis=-1)


def test_the_mirrored_ground_is_the_ground_at_the_mirrored_place(both):
    xy = points()
    for world in (0, 1):
        here = query.surface(both.select(jnp.int32(world)), xy)
        there = query.surface(both.select(jnp.int32(world + 2)), across(xy))
        np.testing.assert_array_equal(there.semantic, here.semantic)
        np.testing.assert_array_equal(there.friction, here.friction)
        # On triangles of rigid ground as on soil; metres, with coordinates rounded to 1e-6 m.
        np.testing.assert_allclose(there.height, here.height, atol=2e-5)
        assert len(np.unique(here.semantic)) > 5


def test_obstacles_are_mirrored_and_unused_ones_stay_unused(both):
    xy = points()
    yaw = jnp.zeros(xy.shape[:-1])
    here = obstacles.collides(both.select(jnp.int32(1)), xy, yaw, 0.1, 0.2)
    there = obstacles.collides(both.select(jnp.int32(3)), across(xy), yaw, 0.2, 0.1)
    np.testing.assert_array_equal(here, there)
    assert here.sum() > 10
    np.testing.assert_array_equal(both.obstacles[:, 2], 0)


def test_a_mirrored_vehicle_sees_the_mirrored_patch(both):
    state = np.zeros((1, 2, 12), np.float32)
    state[..., :2], state[..., 5] = (5.0, 4.3), 0.7
    windows = Windows(state, np.zeros((1, 1, 2)), jnp.array([1]), jnp.array([0]), 0)
    image = augment.mirror(windows, both)

    def look(windows):
        terrain = both.select(windows.world[0])
        return patches.query(terrain, windows.state[0, 0, :3], windows.state[0, 0, 5])

    here, there = look(windows), look(image)
    same = np.isclose(there.elevation[:, ::-1], here.elevation)
    assert same.mean() > 0.999  # a pixel may fall on the border between two vertices
    assert np.isclose(there.rgb[:, ::-1], here.rgb).all(axis=-1).mean() > 0.999


def test_poses_and_twists_are_those_of_a_mirrored_body(both):
    rng = np.random.default_rng(5)
    state = rng.uniform(-1.2, 1.2, (3, C + 2, 12)).astype(np.float32)
    windows = Windows(
        state,
        rng.normal(size=(3, C + 1, 2)).astype(np.float32),
        jnp.array([0, 1, 1]),
        jnp.array([0, 1, 2]),
        C,
    )
    image = augment.mirror(jax.tree.map(jnp.asarray, windows), both)
    exchange, flip = np.eye(3)[[1, 0, 2]], np.diag([1, -1, 1])  # in the world, in the body
    rotation = geometry.rotation_from_rpy(state[..., 3:6]).as_matrix()
    turned = geometry.rotation_from_rpy(image.state[..., 3:6]).as_matrix()
    np.testing.assert_allclose(turned, exchange @ rotation @ flip, atol=1e-5)
    np.testing.assert_allclose(image.state[..., :2], across(state[..., :2]), atol=1e-5)
    np.testing.assert_array_equal(image.state[..., 2], state[..., 2])
    np.testing.assert_array_equal(image.state[..., 6:9], state[..., 6:9] @ flip)
    # Angular velocity is a pseudovector.
    np.testing.assert_array_equal(image.state[..., 9:], -state[..., 9:] @ flip)
    np.testing.assert_array_equal(image.control, windows.control * [1, -1])
    np.testing.assert_array_equal(image.world, [2, 3, 3])
    np.testing.assert_array_equal(image.ground, windows.ground)


def test_some_are_mirrored_and_the_others_left_alone(both):
    state = np.random.default_rng(0).uniform(-1, 1, (400, 3, 12)).astype(np.float32)
    windows = Windows(
        state, jnp.ones((400, 2, 2)), jnp.zeros(400, jnp.int32), jnp.zeros(400, jnp.int32), 1
    )
    some, every = (
        augment.mirror_some(jax.random.key(0), windows, both),
        augment.mirror(windows, both),
    )
    mirrored = np.asarray(some.world) == 2
    assert 150 < mirrored.sum() < 250
    np.testing.assert_array_equal(some.state[mirrored], every.state[mirrored])
    np.testing.assert_array_equal(some.state[~mirrored], state[~mirrored])
    np.testing.assert_array_equal(some.control[:, 0, 1], np.where(mirrored, -1, 1))


@pytest.mark.integration
def test_the_simulator_drives_the_mirror_image_of_what_it_drives():
    drives, terrain = dataset.load_drives(DRIVES, "train")
    windows = gather(drives, index(drives, terrain, context=C, horizon=16, stride=20))
    both = augment.with_mirrored(terrain)
    simulator, params = Simulator(), chrono_like(load_vehicle())

    @jax.jit
    @jax.vmap
    def predict(state, control, world):
        ground, states = both.select(world), VehicleState.from_vector(state)
        before = jax.tree.map(lambda x: x[: C + 1], states)
        start = jax.tree.map(lambda x: x[C], states)
        context, ahead = (Command.from_vector(c) for c in (control[:C], control[C:]))
        history = warm_up(simulator, params, ground, before, context)
        return rollout(simulator, params, ground, start, ahead, history).vector

    def predicted(windows):
        return predict(windows.state, windows.control, windows.world)

    expected = augment.mirror(replace(windows, state=predicted(windows)), both).state
    error = np.array(predicted(augment.mirror(windows, both)) - expected)
    error[..., 5] = geometry.wrap(error[..., 5])
    final, ground = np.linalg.norm(error[:, -1, :3], axis=-1), np.asarray(windows.ground)
    # Where two points of the hull touch at once, and where soil begins under a wheel, the
    # simulator decides by one side; all else is exact up to rounding.
    for kind in (0, 1):
        assert (ground == kind).sum() > 15
        assert np.median(final[ground == kind]) < 2e-5
        assert np.quantile(final[ground == kind], 0.8) < 2e-4


def test_maps_that_are_not_square_are_refused():
    with pytest.raises(MapError, match=r"elevation: expected a square map, found 17 x 16"):
        augment.with_mirrored(world(0, elevation=np.ones((17, 16))))
