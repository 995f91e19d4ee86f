"""Ground from the GridMap messages of bags."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from importers.bags import Bag

from vertiwm_jax.importers import grid_map
from vertiwm_jax.importers.grid_map import Canvas
from vertiwm_jax.importers.settings import Frames, GridMapSettings
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.terrain import query

LAYERS = GridMapSettings("/map", semantic="kind")
SAND, GRASS = 8, 3
RESOLUTION = 0.5


def height(x, y):
    """A plane that tells x from y and their signs."""
    return 5 + 0.1 * x - 0.03 * y


def patch(centre, rows=20, columns=30):
    """Heights, and sand in the north, around `[2]` m; index (0, 0) at the largest x and y."""
    x = centre[0] + RESOLUTION * ((rows - 1) / 2 - np.arange(rows))
    y = centre[1] + RESOLUTION * ((columns - 1) / 2 - np.arange(columns))
    x, y = np.meshgrid(x, y, indexing="ij")
    return {"variance": 0 * x, "elevation": height(x, y), "kind": np.where(y > 0, SAND, np.nan)}


@pytest.mark.parametrize("name", ["a.bag", "a"])
def test_patches_become_one_map(name, tmp_path):
    """A map that rolls along with the robot, as a ring buffer, with holes."""
    holed = patch((4.0, 2.0))
    holed["elevation"][3:5, 7:9] = np.nan
    with Bag(tmp_path / name) as bag:
        bag.grid_map(1.0, patch((0.0, 0.0)), (0, 0), RESOLUTION, start=(3, 7))
        bag.grid_map(2.0, holed, (4.0, 2.0), RESOLUTION, start=(11, 5))
    terrain, unknown = grid_map.terrain([tmp_path / name], LAYERS, Frames())
    # 14 m by 17 m from the first to the last cell of both.
    assert terrain.elevation.shape == (1, 34, 28)
    np.testing.assert_allclose(terrain.origin, [-4.75, 9.25])
    # What neither covers: 8 by 4 cells at two corners, and of the hole what only the second knows.
    covered = 2 * 600 - 12 * 26
    hole = 4
    assert unknown == pytest.approx(1 - (covered - hole) / (34 * 28))
    xy = np.random.default_rng(0).uniform([-4, -7], [4, 7], (50, 2))
    ground = query.surface(terrain, jnp.asarray(xy))
    np.testing.assert_allclose(ground.height, height(*xy.T), atol=1e-4)
    np.testing.assert_allclose(ground.gradient, [[0.1, -0.03]] * 50, atol=1e-4)
    away = np.abs(xy[:, 1]) > RESOLUTION
    kinds = np.where(xy[:, 1] > 0, SAND, GRASS)
    np.testing.assert_array_equal(ground.semantic[away], kinds[away])


def test_the_world_may_begin_elsewhere(tmp_path):
    with Bag(tmp_path / "a") as bag:
        bag.grid_map(1.0, patch((1000.0, 500.0)), (1000.0, 500.0), RESOLUTION)
    frames = Frames(origin=(1000.0, 500.0, 80.0))
    layers = replace(LAYERS, semantic=None, ground="sand")
    terrain, unknown = grid_map.terrain([tmp_path / "a"], layers, frames)
    ground = query.surface(terrain, jnp.zeros(2))
    assert unknown == 0 and int(ground.semantic) == SAND
    assert float(ground.height) == pytest.approx(height(1000, 500) - 80, abs=1e-3)


def test_the_newest_height_stays():
    canvas = Canvas(np.zeros((1, 2, 2)), np.array([0.25, 0.25]), 1.0)
    canvas.paint(np.array([[[1.0, np.nan]]]), np.array([1.25, 0.25]))
    canvas.paint(np.full((1, 1, 1), 7.0), np.array([-0.75, -0.75]))
    expected = [[7, np.nan, np.nan], [np.nan, 0, 0], [np.nan, 1, 0]]
    np.testing.assert_array_equal(canvas.values[0], expected)
    np.testing.assert_allclose(canvas.origin, [-0.75, -0.75])


def test_maps_that_cannot_be_used_are_named(tmp_path):
    with Bag(tmp_path / "a") as bag:
        bag.grid_map(1.0, patch((0.0, 0.0)), (0, 0), RESOLUTION)
        bag.grid_map(2.0, patch((0.0, 0.0)), (0, 0), 2 * RESOLUTION)
    with Bag(tmp_path / "b") as bag:
        bag.grid_map(1.0, {"elevation": np.full((4, 4), np.nan)}, (0, 0), 1.0)
    cases = {
        ("a", LAYERS): "/map: expected 0.5 m between cells as before, found 1",
        ("a", replace(LAYERS, elevation="z")): "/map: expected a layer z, found variance, elev",
        ("a", replace(LAYERS, topic="/none")): "/none: expected messages of grid_map_msgs/msg/",
        ("b", GridMapSettings("/map")): "/map: elevation: expected heights, found none that is",
    }
    for (name, layers), message in cases.items():
        with pytest.raises(DataError, match=message):
            grid_map.terrain([tmp_path / name], layers, Frames())
    with pytest.raises(ValueError, match=r"ground: expected one of clay, .*, found lava"):
        GridMapSettings("/map", ground="lava")
