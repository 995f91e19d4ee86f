"""Ways to goals: level ground is as far as it looks, and what is hard is gone round."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import GRASS, ground, hills
from scipy.sparse import csgraph

from vertiwm_jax.env import route
from vertiwm_jax.env.route import RouteConfig, TraversabilityCost, footprint, places
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain.map import TerrainMap

HMMWV = load_vehicle()
CONFIG = RouteConfig(cells=32)
EAST = jnp.array([[50.0, 1.0]])


def to(goal, terrain, config=CONFIG, world=None):
    world = jnp.zeros(len(goal), jnp.int32) if world is None else world
    return route.plan(config, terrain, HMMWV, world, jnp.asarray(goal, jnp.float32))


def ridge(gap):
    """Hills of 4 m on a strip from south to north, with a gap of 16 m about y = `gap`."""
    x = np.arange(-64.0, 65.0)
    east, north = np.meshgrid(x, -x)
    height = 2 + 2 * np.sin(1.2 * east) * np.sin(1.2 * north)
    return ground(np.where((np.abs(east) < 8) & (np.abs(north - gap) > 8), height, 2.0))


def walked(routes, terrain, start, stride=2.0):
    """The way down the cost to go, stride by stride, `[N, 2]` m."""
    turns = jnp.linspace(0, 2 * jnp.pi, 65)[:-1]
    around = stride * jnp.stack([jnp.cos(turns), jnp.sin(turns)], axis=-1)

    @jax.jit
    def go_on(xy):
        return xy + around[jnp.argmin(routes.cost_to_go(terrain, xy + 2 * around))]

    way = [jnp.asarray(start)]
    while len(way) < 150 and float(routes.cost_to_go(terrain, way[-1])) > 4:
        way.append(go_on(way[-1]))
    return np.array(way)


def test_level_ground_costs_its_length():
    routes = to([[50.0, 1.0], [-20.0, 33.3]], ground())
    places = np.random.default_rng(0).uniform(-60, 60, (500, 2)).astype(np.float32)
    for number, goal in enumerate([[50.0, 1.0], [-20.0, 33.3]]):
        distance = np.linalg.norm(places - np.array(goal), axis=1)
        cost = routes.select(jnp.int32(number)).cost_to_go(ground(), jnp.asarray(places))
        # Moves in sixteen directions are at most 1 / cos(13.3 degrees) of the way too long.
        inside = (np.abs(places) < 54).all(axis=1) & (distance > 8)
        assert (cost[inside] >= 0.995 * distance[inside]).all()
        assert (cost[inside] <= 1.028 * distance[inside] + 0.5).all()


@pytest.mark.parametrize("gap", [-40.0, 0.0, 30.0])
def test_ways_lead_through_the_gap_of_a_ridge(gap):
    terrain = ridge(gap)
    routes = to(EAST, terrain)
    way = walked(routes, terrain, [-50.0, 0.0])
    assert np.linalg.norm(way[-1] - EAST[0]) < 6
    crossing = way[np.abs(way[:, 0]) < 8]
    assert len(crossing) > 3 and (np.abs(crossing[:, 1] - gap) < 10).all()
    # Only who finds it worth while goes round.
    blind = walked(to(EAST, terrain, RouteConfig(cells=32, detour=0.0)), terrain, [-50.0, 0.0])
    assert np.abs(blind[:, 1]).max() < 4


def test_ways_lead_round_obstacles_unless_they_are_low():
    rocks = np.array([[0.0, 10.0 * i, 3.0, 9.0, 1.0] for i in range(-3, 4)])
    terrain = ground(obstacles=rocks)
    way = walked(to(EAST, terrain), terrain, [-50.0, 0.0])
    assert np.linalg.norm(way[-1] - EAST[0]) < 6
    assert np.abs(way[np.abs(way[:, 0]) < 2, 1]).min() > 34
    rocks[:, 4] = 0.0  # rows that are not in use
    unused = ground(obstacles=rocks)
    np.testing.assert_array_equal(to(EAST, unused).cost, to(EAST, ground()).cost)


@pytest.mark.integration
def test_costs_are_those_of_the_cheapest_way():
    """Dijkstra's algorithm finds the same, over moves whose costs are computed one by one."""
    cells, terrain = 12, ground(hills())
    config = RouteConfig(cells=cells, detour=3.0)
    size, heights = 128 / cells, np.asarray(terrain.elevation[0])
    weights = np.full((cells**2, cells**2), np.inf)

    def bilinear(xy):
        column, row = np.clip(xy[..., 0] + 64, 0, 128), np.clip(64 - xy[..., 1], 0, 128)
        r, c = np.minimum(row.astype(int), 127), np.minimum(column.astype(int), 127)
        u, v = column - c, row - r
        upper = heights[r, c] * (1 - u) + heights[r, c + 1] * u
        return upper * (1 - v) + (heights[r + 1, c] * (1 - u) + heights[r + 1, c + 1] * u) * v

    for row in range(cells):
        for column in range(cells):
            for east, north in [(a, b) for a in range(-2, 3) for b in range(-2, 3)]:
                to_row, to_column = row - north, column + east
                on_map = 0 <= to_row < cells and 0 <= to_column < cells
                if np.gcd(east, north) != 1 or not on_map:
                    continue
                begin = np.array([-64 + (column + 0.5) * size, 64 - (row + 0.5) * size])
                move = size * np.array([east, north])
                heading, hard = np.arctan2(north, east), []
                for share in (0.0, 0.5, 1.0):
                    at = np.array(places(HMMWV, begin + share * move, jnp.float32(heading)))
                    below = footprint(HMMWV, jnp.asarray(bilinear(at)))
                    parts = below.crown, below.rise, below.bank, below.twist
                    hard.append(float(TraversabilityCost()(*parts)))
                off = np.abs(begin + move / 2).max() > 64 - HMMWV.length / 2
                each = 1 + 3.0 * np.mean(hard) + 10.0 * off
                weights[row * cells + column, to_row * cells + to_column] = np.hypot(*move) * each
    goal = 5 * cells + 9
    middle = [-64 + (9 + 0.5) * size, 64 - (5 + 0.5) * size]
    found = np.asarray(to([middle], terrain, config).cost[0]).ravel()
    for r, c in [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if r or c]:
        weights[goal + r * cells + c, goal] = size * np.hypot(r, c)  # straight, near the goal
    expected = csgraph.dijkstra(np.where(np.isinf(weights), 0, weights).T, indices=goal)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-3)


def test_turning_the_world_turns_the_way():
    terrain = ridge(20.0)
    turned = ground(np.rot90(terrain.elevation[0]))
    here = to([[40.0, -10.0]], terrain).cost[0]
    there = to([[10.0, 40.0]], turned).cost[0]
    np.testing.assert_allclose(there, np.rot90(here), rtol=1e-4)


def test_each_goal_has_the_ground_of_its_world():
    one, other = ridge(30.0), ground(hills())
    both = terrain_map.stack([one, other])
    goals = [[50.0, 1.0], [-40.0, 7.0], [50.0, 1.0]]
    routes = to(goals, both, world=jnp.array([0, 1, 1]))
    for number, terrain in enumerate((one, other, other)):
        alone = to(goals[number : number + 1], terrain).cost[0]
        np.testing.assert_allclose(routes.cost[number], alone, rtol=1e-5)
    assert (np.asarray(routes.cost[0]) != np.asarray(routes.cost[2])).any()


def test_maps_need_not_be_square():
    terrain = TerrainMap.from_array(np.zeros((65, 129)), np.full((8, 16), GRASS))
    routes = to([[50.0, 20.0]], terrain)
    found = routes.cost_to_go(terrain, jnp.array([[-50.0, 20.0], [50.0, -20.0]]))
    np.testing.assert_allclose(found, [100.0, 40.0], rtol=0.03)


def test_places_beside_the_map_and_none_at_all_have_a_cost_too():
    terrain = ground(hills())
    routes = to(EAST, terrain)
    beside = routes.cost_to_go(terrain, jnp.array([[90.0, 3.0], [-3.0, -1e9], [np.nan, 0.0]]))
    edge = routes.cost_to_go(terrain, jnp.array([[64.0, 3.0], [-3.0, -64.0], [-64.0, 0.0]]))
    np.testing.assert_allclose(beside, edge, rtol=1e-5)
    slope = jax.grad(lambda xy: routes.cost_to_go(terrain, xy))
    # The cost to go falls along the way.
    east, north = slope(jnp.array([20.0, 1.0]))
    assert east < -0.9 and abs(north) < 0.5
    assert np.isfinite(slope(jnp.array([np.nan, 200.0]))).all()


def test_without_knowing_the_ground_the_way_is_straight():
    terrain = ridge(30.0)
    straight = route.straight(CONFIG, terrain, EAST)
    start = jnp.array([-50.0, 0.0])
    assert float(straight.cost_to_go(terrain, start)) == pytest.approx(100.0, abs=0.1)
    assert np.abs(walked(straight, terrain, start)[:, 1]).max() < 3


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cells": 3}, "cells: expected at least 4, found 3"),
        ({"detour": -1.0}, "detour: expected at least 0, found -1.0"),
        ({"blocked": np.nan}, "blocked: expected at least 0, found nan"),
    ],
)
def test_settings_that_cannot_be(settings, message):
    with pytest.raises(ValueError, match=message):
        RouteConfig(**settings)
