from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import GRASS, SNOW, hills

from vertiwm_jax.terrain import correction, query
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain.map import TerrainMap

ORIGIN = (-60.0, 62.0)
ROCK = 5
WORLD = TerrainMap.from_array(hills(), np.full((16, 16), GRASS), origin=ORIGIN)
WORLDS = terrain_map.stack([WORLD, WORLD]).select(jnp.int32(1))


@pytest.mark.parametrize("corner", [(3.2, -4.4), (-62.0, 63.0), (66.0, -64.0), (300.0, 0.0)])
def test_measured_heights_stand_where_they_were_measured(corner):
    measured = np.random.default_rng(0).uniform(5, 9, (5, 7)).astype(np.float32)
    measured[1, 2] = np.nan
    found = correction.heights(WORLDS, jnp.asarray(corner), jnp.asarray(measured))
    expected = np.stack([hills(), hills()])
    first = round(ORIGIN[1] - corner[1]), round(corner[0] - ORIGIN[0])
    for i, j in np.ndindex(measured.shape):
        row, column = first[0] + i, first[1] + j
        if 0 <= row < 129 and 0 <= column < 129 and np.isfinite(measured[i, j]):
            expected[1, row, column] = measured[i, j]
    np.testing.assert_array_equal(found.elevation, expected)
    chex.assert_trees_all_equal(replace(found, elevation=WORLDS.elevation), WORLDS)


@pytest.mark.parametrize("corner", [(5.0, 5.0), (-70.0, 63.0)])
def test_measured_classes_are_met_there(corner):
    semantic = np.array([[SNOW, -1, ROCK], [ROCK, SNOW, 10]])  # there are ten classes
    friction = np.full((2, 3), 0.7, np.float32)
    found = correction.classes(WORLDS, jnp.asarray(corner), semantic, friction)
    expected = np.full((2, 16, 16), GRASS)
    row, column = int((ORIGIN[1] - corner[1]) // 8), int((corner[0] - ORIGIN[0]) // 8)
    for i, j in np.ndindex(semantic.shape):
        if 0 <= semantic[i, j] < 10 and row + i >= 0 and column + j >= 0:
            expected[1, row + i, column + j] = semantic[i, j]
    np.testing.assert_array_equal(found.semantic, expected)
    changed = expected != GRASS
    np.testing.assert_allclose(found.friction[changed], 0.7 * (expected[changed] == ROCK))
    np.testing.assert_array_equal(found.friction[~changed], WORLDS.friction[~changed])
    here = query.surface(found, jnp.array([-1.0, -5.0]))
    assert int(here.semantic) == expected[1, 67 // 8, 59 // 8]


def test_a_map_is_corrected_again_and_again_in_one_program():
    chex.clear_trace_counter()

    @jax.jit
    @chex.assert_max_traces(n=1)
    def height(terrain, corner, measured):
        terrain = correction.heights(terrain, corner, measured)
        return terrain, query.height(terrain, corner)

    terrain = WORLD
    for number in range(3):
        corner = jnp.array([4.0 * number, 2.0])
        terrain, found = height(terrain, corner, jnp.full((3, 3), 5.0 + number))
        assert float(found) == 5.0 + number


def test_shapes_that_do_not_fit_are_named():
    corner, row = jnp.zeros(2), jnp.zeros(4)
    with pytest.raises(ValueError, match=r"measured: expected two axes, found shape \(4,\)"):
        correction.heights(WORLD, corner, row)
    with pytest.raises(ValueError, match=r"corner: expected shape \(2,\).* found \(3,\)"):
        correction.heights(WORLD, jnp.zeros(3), row[None])
    with pytest.raises(ValueError, match=r"friction: expected shape \(2, 2\) .*found shape \(4,\)"):
        correction.classes(WORLD, corner, jnp.zeros((2, 2), int), row)
