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


def test_a_skid_steered_vehicle_is_told_speed_and_yaw_rate_however_they_were_logged():
    wheels = np.random.default_rng(0).uniform(-2, 2, (200, 2))
    speed, yaw_rate = commands.of_vehicle(wheels, "wheels", SKID).T
    np.testing.assert_allclose([speed, yaw_rate], commands.differential(*wheels.T, SKID.track))
    around = np.array([[0.0, 0.5], [0.0, -3.0]])
    np.testing.assert_array_equal(commands.of_vehicle(around, "yaw_rate", SKID), around)
    bicycle = np.array([[2.0, 0.3], [-1.0, 0.3], [0.0, 0.3]])
    turned = commands.of_vehicle(bicycle, "steering", SKID)[:, 1]
    np.testing.assert_allclose(turned, bicycle[:, 0] * np.tan(0.3) / SKID.wheelbase)
    np.testing.assert_array_equal(commands.of_vehicle(bicycle, "steering", VEHICLE), bicycle)


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
