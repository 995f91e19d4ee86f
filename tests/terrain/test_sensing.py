from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import GRASS, SNOW, hills
from scipy.interpolate import RegularGridInterpolator

from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain import obstacles, patches, query, sensing
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.sensing import SensingConfig

DISC = SensingConfig(range=12.0)
SECTOR = SensingConfig(range=15.0, field_of_view=2.0, cells=40)
ROCKS = np.array([[9.0, 2.0, 4.0, 4.0, 2.0], [14.0, 0.0, 5.0, 5.0, 2.0]], np.float32)
POSES = [(0.0, 0.0, 0.3), (4.0, -3.0, 2.5), (-50.0, 60.0, -1.0)]
look = jax.jit(sensing.look, static_argnums=0)


def world(elevation=None, origin=(-60.0, 62.0)):
    semantic = np.where(np.add.outer(np.arange(16), np.arange(16)) % 2, SNOW, GRASS)
    relief = hills() if elevation is None else elevation
    return TerrainMap.from_array(relief, semantic, obstacles=ROCKS, origin=origin)


def at(x, y, yaw):
    return jnp.array([x, y, 1.0]), jnp.float32(yaw)


def along(config, terrain, poses):
    for pose in poses:
        terrain = replace(terrain, observed=look(config, terrain, *at(*pose)))
    return terrain.observed


def seen_from(config, x, y, yaw, origin=(-60.0, 62.0), side=128.0):
    """One cell after the other, by angles."""
    known, cell = np.zeros((config.cells, config.cells), bool), side / config.cells
    for i, j in np.ndindex(known.shape):
        east = origin[0] + (j + 0.5) * cell - x
        north = origin[1] - (i + 0.5) * cell - y
        off = np.arctan2(north, east) - yaw
        off = abs(np.arctan2(np.sin(off), np.cos(off)))
        distance = np.hypot(east, north)
        inside = off <= config.field_of_view / 2 or distance <= sensing.NEAR
        known[i, j] = distance <= config.range and inside
    return known


def vertices(known):
    """Whether each of 129 x 129 vertices lies in a known cell."""
    row = np.minimum(np.arange(129) * len(known) // 128, len(known) - 1)
    return known[np.ix_(row, row)]


def interpolated(grid, heights, xy):
    north, east = grid
    return RegularGridInterpolator((-north, east), heights)(np.stack([-xy[:, 1], xy[:, 0]], -1))


@pytest.mark.parametrize("config", [DISC, SECTOR, SensingConfig(range=3.0)])
def test_cells_become_known_as_counted_one_by_one_and_stay_so(config):
    terrain, known = world(), np.zeros((config.cells, config.cells), bool)
    for number, pose in enumerate(POSES, start=1):
        before, known = known, known | seen_from(config, *pose)
        found = np.asarray(along(config, terrain, POSES[:number]).known)
        np.testing.assert_array_equal(found, known)
        assert (found >= before).all() and found.sum() > before.sum()


def test_unknown_ground_lies_in_the_plane_through_what_is_seen():
    """By scipy: heights between vertices, and least squares in world coordinates."""
    terrain, (x, y, yaw) = world(), POSES[1]
    observed = look(SECTOR, terrain, *at(x, y, yaw))
    forward, left = np.stack(sensing._places(SECTOR)).astype(np.float64)
    assert np.hypot(forward, left).max() < SECTOR.range
    xy = np.stack(
        [x + np.cos(yaw) * forward - np.sin(yaw) * left,
         y + np.sin(yaw) * forward + np.cos(yaw) * left], axis=-1,
    )  # fmt: skip
    # What is not seen is level with the ground below, until there is a plane.
    grid = 62.0 - np.arange(129.0), -60.0 + np.arange(129.0)
    below = interpolated(grid, hills(), np.array([[x, y]]))
    assumed = np.where(vertices(seen_from(SECTOR, x, y, yaw)), hills(), below)
    heights = interpolated(grid, assumed, xy)
    plane = np.linalg.lstsq(np.c_[np.ones(len(xy)), xy], heights, rcond=None)[0]
    np.testing.assert_allclose(observed.plane, plane, atol=1e-4)
    far = np.array([[30.0, -40.0], [-20.0, 10.0]])
    found = query.height(replace(terrain, observed=observed), jnp.asarray(far, jnp.float32))
    np.testing.assert_allclose(found, plane[0] + far @ plane[1:], atol=1e-3)


@pytest.mark.parametrize("config", [DISC, SECTOR])
def test_an_incline_goes_on_as_far_as_the_map(config):
    slope = 8 + 0.05 * (np.arange(129)[None, :] - 64) - 0.03 * (np.arange(129)[:, None] - 64)
    terrain = world(slope)
    # By the second look, what was guessed of the plane's rim is right.
    observed = along(config, terrain, [POSES[0]] * 12)
    xy = jnp.asarray(np.random.default_rng(0).uniform(-59, 60, (200, 2)), jnp.float32)
    expected = query.height(terrain, xy)
    np.testing.assert_allclose(
        query.height(replace(terrain, observed=observed), xy), expected, 0.02
    )


def test_unknown_ground_is_like_that_below_and_what_is_known_is_as_it_is():
    terrain, (x, y, yaw) = world(), POSES[0]
    observed_map = replace(terrain, observed=look(DISC, terrain, *at(x, y, yaw)))
    below = query.surface(terrain, jnp.array([x, y]))
    far = query.surface(observed_map, jnp.array([[40.0, 40.0], [48.0, 40.0]]))
    np.testing.assert_array_equal(far.semantic, below.semantic)
    np.testing.assert_array_equal(far.friction, below.friction)
    near = jnp.array([[5.0, 5.0], [-5.0, 5.0], [7.0, -2.0]])
    chex.assert_trees_all_equal(query.surface(observed_map, near), query.surface(terrain, near))
    seen = [patches.query(ground, *at(x, y, yaw)) for ground in (observed_map, terrain)]
    chex.assert_trees_all_equal(*seen)


def test_rocks_are_there_once_their_middle_is_seen():
    terrain, poses = world(), jnp.asarray(ROCKS[:, :2])
    yaw = jnp.zeros(2)
    assert obstacles.collides(terrain, poses, yaw, 4.6, 2.2).all()
    for pose, expected in ((POSES[0], [True, False]), (POSES[2], [False, False])):
        observed_map = replace(terrain, observed=look(DISC, terrain, *at(*pose)))
        np.testing.assert_array_equal(
            obstacles.collides(observed_map, poses, yaw, 4.6, 2.2), expected
        )


@pytest.mark.parametrize("config", [DISC, SECTOR])
def test_what_was_not_seen_does_not_matter(config):
    terrain = world()
    known = np.asarray(along(config, terrain, POSES).known)
    other = replace(
        terrain,
        elevation=jnp.where(vertices(known), terrain.elevation, 9.0),
        obstacles=terrain.obstacles.at[:, 1, 0].add(20.0),
    )
    observations = along(config, terrain, POSES), along(config, other, POSES)
    chex.assert_trees_all_equal(*observations)
    xy = jnp.asarray(np.random.default_rng(0).uniform(-64, 64, (500, 2)), jnp.float32)
    seen = [
        (query.surface(ground, xy), query.height(ground, xy))
        for ground in (replace(g, observed=observations[0]) for g in (terrain, other))
    ]
    chex.assert_trees_all_equal(*seen)
    assert not np.allclose(query.height(terrain, xy), query.height(other, xy))


def test_many_vehicles_on_many_worlds_are_each_their_own_in_one_program():
    terrain = terrain_map.stack([world(), world(hills(height=2.0))])
    chex.clear_trace_counter()

    @jax.jit
    @chex.assert_max_traces(n=1)
    def height(worlds, positions, yaws):
        def one(world, position, yaw):
            ground = terrain.select(world)
            observed = sensing.look(SECTOR, ground, position, yaw)
            return observed, query.height(
                replace(ground, observed=observed), jnp.array([20.0, 0.0])
            )

        return jax.vmap(one)(worlds, positions, yaws)

    poses = [at(*pose) for pose in POSES]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *poses)
    for worlds in ([0, 1, 0], [1, 1, 0]):
        found = height(jnp.array(worlds), *stacked)
        for i, (number, pose) in enumerate(zip(worlds, poses, strict=True)):
            ground = terrain.select(jnp.int32(number))
            observed = look(SECTOR, ground, *pose)
            alone = (
                observed,
                query.height(replace(ground, observed=observed), jnp.array([20.0, 0.0])),
            )
            chex.assert_trees_all_close(jax.tree.map(lambda x, i=i: x[i], found), alone, atol=1e-5)


def test_what_has_no_sense_is_refused():
    for wrong, message in (
        ({"range": 0.0}, "range: expected more than 0, found"),
        ({"range": np.nan}, "range: expected more than 0, found"),
        ({"field_of_view": 7.0}, "field_of_view: expected more than 0 and at most 6.28319"),
        ({"cells": 0}, "cells: expected at least 1"),
    ):
        with pytest.raises(ValueError, match=message):
            SensingConfig(**wrong)
    with pytest.raises(ValueError, match=r"sensing.cells: expected at least 23 on a map of 128 x"):
        sensing.check(SensingConfig(range=12.0, cells=16), world())
    sensing.check(SensingConfig(range=12.0, cells=23), world())
    sensing.check(SensingConfig(cells=1), world())
