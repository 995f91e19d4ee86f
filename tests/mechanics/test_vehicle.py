"""Vehicles as files, and the same vehicle at another size."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from vertiwm_jax import config, froude
from vertiwm_jax.config import ConfigError
from vertiwm_jax.dynamics import rollout
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.kinematic import bicycle_of, place
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.state import Command
from vertiwm_jax.terrain.map import TerrainMap

CONCRETE = 1
ROVER = vehicle.load("rover")


def test_files_hold_si_units_and_wheels_are_in_order():
    found = load_vehicle()
    assert found.mass == np.float32(2493.6) and found.wheelbase == np.float32(3.302)
    np.testing.assert_allclose(
        found.wheel_position, [[1.651, 0.91], [1.651, -0.91], [-1.651, 0.91], [-1.651, -0.91]]
    )
    np.testing.assert_allclose(found.spring, [147e3, 147e3, 265e3, 265e3])
    # As it was measured in Chrono.
    np.testing.assert_allclose(bicycle_of(found).ride_height, 0.43, atol=0.01)


def test_a_rover_at_full_size_is_about_an_hmmwv():
    full, known = ROVER.vehicle, load_vehicle()
    for name in ("mass", "wheel_radius", "wheelbase", "track", "wheel_torque", "wheel_power"):
        assert 0.5 < getattr(full, name) / getattr(known, name) < 2, name
    # The force of a relaxed spring that is lifted by its static deflection carries the weight.
    load = full.spring * (full.travel_at_rest - full.free_travel) + full.wheel_weight
    np.testing.assert_allclose(load.sum(), full.mass * 9.81, rtol=1e-5)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("mass", -3.5, "mass: expected more than 0, found -3.5"),
        ("scale", 0.0, "scale: expected more than 0, found 0.0"),
        ("track", ".nan", "track: expected more than 0, found nan"),
        ("track", ".inf", "track: expected finite numbers"),
        ("free_travel", [0.1, ".nan"], "free_travel: expected finite numbers"),
        ("spring", [1.0], "spring: expected a list of 2 (float, float), found a list of 1"),
        ("hull", [0.1, 0.1, 0.2, 0.1], "hull: expected half the length and half the width"),
        ("inertia", [1.0, 2.0, 9.0], "inertia: expected no moment larger than the sum"),
        ("wheels", 4, "wheels: unknown key"),
        ("reverse_torque", 0.0, "reverse_torque: expected more than 0, found 0.0"),
        ("drive", "back", "drive: expected one of 'all', 'rear', 'front', found 'back'"),
        ("locked", "rear", "locked: expected none or front, as these wheels are driven"),
        ("wheel_radius", [0.5, 0.0], "wheel_radius: expected more than 0, found (0.5, 0.0)"),
        ("mass", "heavy", "mass: expected float, found 'heavy'"),
        ("scale", 1.0, "scale: expected about 8.5, by which wheels become as large as an HMMWV's"),
        ("length", 1.2, "length: expected corners within 0.56 m of the middle"),
    ],
)
def test_what_cannot_be_a_vehicle_is_named(tmp_path, field, value, words):
    numbers = yaml.safe_load(config.dump(replace(ROVER, drive="front"))) | {field: value}
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(numbers).replace("'.nan'", ".nan").replace("'.inf'", ".inf"))
    with pytest.raises(ConfigError) as refused:
        vehicle.load(str(file))
    assert str(refused.value).startswith(f"{file}: ") and words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_vehicle_is_found_by_name_or_by_file(tmp_path):
    config.save(replace(ROVER, mass=4.0), tmp_path / "mine.yaml")
    assert vehicle.load(str(tmp_path / "mine.yaml")) == replace(ROVER, mass=4.0)
    known = "expected one of hmmwv, husky, rover, warthog; did you mean 'rover'"
    with pytest.raises(ConfigError, match=known):
        vehicle.load("rovr")
    with pytest.raises(ConfigError, match=r"yours\.yaml: no such file"):
        vehicle.load(str(tmp_path / "yours.yaml"))


@pytest.mark.integration
def test_the_same_drive_at_four_times_the_size_takes_twice_as_long():
    """Over waves, with steering: the simulator at both sizes, with as many sub-steps altogether."""
    x, y = np.meshgrid(*[(np.arange(65) - 32.0) / 4] * 2)
    heights = 2 + 0.06 * np.sin(2 * x) + 0.05 * np.sin(3 * y) + 0.1 * x
    semantic = np.full((8, 8), CONCRETE)
    terrain = TerrainMap.from_array(
        heights, semantic, friction=np.full((8, 8), 0.7), resolution=0.25
    )

    def driven(scale, held, substeps):
        params = chrono_like(replace(ROVER, scale=scale).vehicle)
        ground, model = froude.scaled(terrain, scale), Simulator(substeps)
        state = place(ground, yaw=0.3, vehicle=params.vehicle)
        steering = jnp.repeat(0.3 * jnp.sin(0.1 * jnp.arange(30)), held)
        command = Command(jnp.full(30 * held, 1.0 * scale**0.5), steering)
        return jax.jit(rollout, static_argnums=0)(model, params, ground, state, command)

    small, large = driven(1.0, 1, 20), driven(4.0, 2, 10)
    travelled = np.linalg.norm(small.position[-1, :2])
    assert travelled > 2
    np.testing.assert_allclose(large.position[1::2] / 4, small.position, atol=0.02 * travelled)
    np.testing.assert_allclose(large.rpy[1::2], small.rpy, atol=0.05)
    np.testing.assert_allclose(large.velocity[1::2, 0] / 2, small.velocity[:, 0], atol=0.1)


def test_axles_may_differ():
    own = replace(ROVER, scale=1.0, track=(0.2, 0.24), wheel_radius=(0.05, 0.06), wheel_width=0.05)
    found = own.vehicle
    np.testing.assert_allclose(found.wheel_position[:, 1], [0.1, -0.1, 0.12, -0.12])
    np.testing.assert_allclose(found.wheel_radius, [0.05, 0.05, 0.06, 0.06])
    assert found.wheel_width.shape == () and found.track == pytest.approx(0.22)
    # The body origin is between the wheel centers: level ground is below it by the mean radius.
    resting = 0.055 - found.travel_at_rest.mean()
    assert found.ride_height == pytest.approx(resting)


def test_vehicles_are_stacked_and_selected():
    unequal = replace(ROVER, wheel_radius=(0.05, 0.06), drive="rear", locked="rear").vehicle
    several = vehicle.stack([load_vehicle(), unequal])
    first, second = (several.select(jnp.int32(i)) for i in range(2))
    np.testing.assert_array_equal(second.locked, [0, 0, 1, 1])
    np.testing.assert_array_equal(first.driven, [1, 1, 1, 1])
    np.testing.assert_array_equal(first.locked, [0, 0, 0, 0])
    np.testing.assert_allclose(first.wheel_radius, [0.467] * 4)
    np.testing.assert_allclose(second.wheel_radius, unequal.wheel_radius)
    assert first.mass == load_vehicle().mass and second.mass == unequal.mass
    # What none of them has stays away.
    assert vehicle.stack([load_vehicle()] * 2).locked is None
