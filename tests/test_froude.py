"""What is larger is larger in all that it is made of."""

from dataclasses import fields

import numpy as np

from vertiwm_jax import froude
from vertiwm_jax.mechanics.vehicle import Skid, Vehicle, load
from vertiwm_jax.terrain.classes import STANDARD
from vertiwm_jax.terrain.map import TerrainMap


def test_every_quantity_of_a_vehicle_has_its_power():
    names = {field.name for field in (*fields(Vehicle), *fields(Skid))} - {"skid"}
    assert names <= set(froude.POWER)
    small = load("rover").vehicle
    large = froude.scaled(small, 4.0)
    # A wheel that turns half as fast drives as fast for its size; its power drives the weight.
    np.testing.assert_allclose(large.wheel_speed_limit * 2, small.wheel_speed_limit, rtol=1e-6)
    np.testing.assert_allclose(large.wheel_power, small.wheel_power * 64 * 2, rtol=1e-6)
    np.testing.assert_allclose(large.travel_at_rest, small.travel_at_rest * 4, rtol=1e-5)


def test_larger_ground_is_the_same_but_for_its_scale():
    boxes = np.array([[1.0, 1.0, 0.1, 0.2, 0.3]])
    heights, classes = np.full((17, 17), 31.2), np.full((4, 4), 3)
    small = TerrainMap.from_array(
        heights, classes, obstacles=boxes, resolution=0.25, origin=(0.5, 2.0)
    )
    large = froude.scaled(small, 10.0)
    for name in ("elevation", "obstacles", "origin", "resolution"):
        np.testing.assert_allclose(getattr(large, name), 10 * getattr(small, name), rtol=1e-6)
    np.testing.assert_array_equal(large.friction, small.friction)
    sand = STANDARD.names.index("sand")
    assert large.soils.cohesion[0, sand] == 10 * small.soils.cohesion[0, sand]
    assert large.soils.n[0, sand] == small.soils.n[0, sand]
