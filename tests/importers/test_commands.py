"""Commands of skid-steered vehicles, and what no front wheel can say."""

from dataclasses import replace

import numpy as np
import pytest
from importers.logged import VEHICLE

from vertiwm_jax.config import ConfigError
from vertiwm_jax.importers import commands
from vertiwm_jax.importers.settings import ImportSettings, Table

SKID = replace(VEHICLE, steered="skid")


def test_wheel_speeds_are_speed_and_yaw_rate():
    left, right = np.array([[1.0, 1.0], [0.4, 1.6], [-1.0, -1.6], [-1.0, 1.0]]).T
    speed, yaw_rate = commands.differential(left, right, track=1.2)
    np.testing.assert_allclose(speed, [1.0, 1.0, -1.3, 0.0])
    np.testing.assert_allclose(yaw_rate, [0.0, 1.0, -0.5, 2.0 / 1.2])


@pytest.mark.parametrize("scale", [1.0, 9.0])
def test_a_bicycle_turns_as_the_wheels_of_both_sides_do(scale):
    wheels = np.random.default_rng(0).uniform(-2, 2, (200, 2))
    vehicle = replace(SKID, scale=scale)
    speed, angle = commands.of_bicycle(wheels, "wheels", vehicle).T
    _, yaw_rate = commands.differential(*wheels.T, vehicle.track)
    said = np.isfinite(angle)
    turned = speed[said] * np.tan(angle[said]) / vehicle.wheelbase
    np.testing.assert_allclose(turned, yaw_rate[said], atol=1e-9)
    # Only turns about a point within a fifth of the wheelbase are not said.
    assert 0 < (~said).sum() < 100
    np.testing.assert_array_less(np.abs(speed[~said] / yaw_rate[~said]), vehicle.wheelbase / 5)


def test_standing_is_said():
    standing = np.array([[0.0, 0.0], [0.0, 0.001], [-0.001, 0.0]])
    found = commands.of_bicycle(standing, "yaw_rate", SKID)
    np.testing.assert_allclose(found[:, 1], 0.0)
    around = commands.of_bicycle(np.array([[0.0, 0.5]]), "yaw_rate", SKID)
    assert np.isnan(around[0, 1])


def test_wheel_speeds_are_those_of_a_skid_steered_vehicle():
    table = Table("t", ("x", "y"), yaw="yaw", left="l", right="r")
    ImportSettings(SKID, table=table)
    with pytest.raises(ConfigError, match=r"vehicle\.steered: expected skid, .* found front"):
        ImportSettings(VEHICLE, table=table)


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"speed": "v"}, "speed, steering: expected columns of .* found speed"),
        ({"left": "l", "steering": "s"}, "speed, steering: expected .* found left, steering"),
        ({}, "found none"),
        ({"left": "l", "right": "r", "brake": "b"}, "brake: expected a column of speed"),
        ({"speed": "v", "steering": "s", "position": ("x", "y", "z")}, "position: expected x, y"),
    ],
)
def test_columns_that_do_not_fit_are_named(columns, said):
    with pytest.raises(ConfigError, match=said):
        Table(**{"time": "t", "position": ("x", "y"), "yaw": "yaw", **columns})
