"""Logs of x, y and yaw alone on the ground, against places that are known."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from importers.logged import SETTINGS, logged
from scipy.spatial.transform import Rotation

from vertiwm_jax.importers import planar
from vertiwm_jax.importers.log import Log
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.mechanics.kinematic import BicycleParams, place
from vertiwm_jax.terrain.map import TerrainMap

RADIUS = 0.4
ON_WHEELS = replace(SETTINGS, vehicle=replace(SETTINGS.vehicle, wheel_radius=RADIUS))


@pytest.fixture
def level():
    seen = logged(seconds=4)
    return Log(
        time=seen.time,
        position=seen.state[:, :3] * [1, 1, 0],
        attitude=seen.state[:, 3:6] * [0, 0, 1],
        command_time=seen.time,
        command=seen.command,
        velocity=seen.state[:, 6:9],
        angular_velocity=seen.state[:, 9:12],
        name="a.csv",
    )


@pytest.fixture(scope="module")
def rough():
    heights = np.random.default_rng(0).normal(0, 0.3, (61, 61))
    return TerrainMap.from_array(heights, "grass")


def test_what_never_changes_was_not_measured(level):
    assert planar.is_planar(level)
    assert planar.is_planar(replace(level, position=level.position + [0, 0, 80]))
    for axis, name in ((2, "position"), (0, "attitude"), (1, "attitude")):
        changed = getattr(level, name).copy()
        changed[7, axis] = 1e-4
        assert not planar.is_planar(replace(level, **{name: changed}))


def test_a_log_is_set_on_the_ground_under_its_wheels(level, rough):
    found = planar.lifted(level, rough, ON_WHEELS)
    assert found.velocity is None and found.angular_velocity is None
    wheels = BicycleParams(*map(jnp.float32, (2.0, 1.2, RADIUS, 0.2)))
    for k in (0, 57, len(level.time) - 1):
        x, y, yaw = *level.position[k, :2], level.attitude[k, 2]
        state = place(rough, (x, y), yaw, vehicle=wheels)
        np.testing.assert_allclose(found.position[k], state.position, atol=1e-5)
        rpy = found.rotation[k].as_euler("ZYX")[::-1]
        np.testing.assert_allclose(rpy, state.rpy, atol=1e-5)


def test_where_a_receiver_is_on_the_vehicle_counts(level, rough):
    mast = (-0.5, 0.3, 1.2)
    away = Rotation.from_euler("ZYX", level.attitude[:, ::-1]).apply(mast) * [1, 1, 0]
    vehicle = replace(ON_WHEELS.vehicle, logged_point=mast)
    seen = replace(level, position=level.position + away)
    found = planar.lifted(seen, rough, replace(ON_WHEELS, vehicle=vehicle))
    expected = planar.lifted(level, rough, ON_WHEELS)
    below = found.position - found.rotation.apply(mast)
    np.testing.assert_allclose(below, expected.position, atol=1e-5)


def test_without_a_wheel_nothing_stands_on_the_ground(level, rough):
    with pytest.raises(DataError, match=r"a\.csv: z, roll and pitch: expected .* wheel_radius"):
        planar.lifted(level, rough, SETTINGS)


@pytest.mark.parametrize("corner", [(0.0, 0.0), (512345.0, 5234567.0)])
def test_a_plane_is_below_all_logs(level, corner):
    first = replace(level, position=level.position + [*corner, 0])
    logs = [first, replace(first, position=first.position + [700.0, -90.0, 0])]
    ground = planar.plane(logs, "sand")
    assert (np.asarray(ground.elevation) == 0).all()
    low, high = map(np.asarray, ground.extent)
    for log in logs:
        here = log.position[:, :2] - ground.offset()
        assert (here - low > 25).all() and (high - here > 25).all()
    lost = replace(level, position=level.position + [1e12, 0, 0])
    assert planar.plane([level, level, lost], "sand").elevation.size < 1e6
