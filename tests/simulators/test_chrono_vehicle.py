"""Vehicles for Chrono, by their files and by how they drive there."""

import json
from dataclasses import replace

import numpy as np
import pytest
from simulators.test_simulators import drive, ground, without

from vertiwm_jax.mechanics.vehicle import HMMWV, load
from vertiwm_jax.simulators import chrono_vehicle
from vertiwm_jax.simulators.builtin import BuiltIn
from vertiwm_jax.simulators.chrono import Chrono, expect
from vertiwm_jax.simulators.protocol import SimulatorError

TRUCK = replace(
    load(HMMWV),
    mass=4000.0,
    inertia=(2300.0, 6600.0, 8000.0),
    wheelbase=3.8,
    track=(1.9, 2.0),
    wheel_radius=(0.5, 0.55),
    spring=(200e3, 400e3),
    steering_limit=0.5,
    wheel_torque=9000.0,
    wheel_power=60e3,
    brake_torque=7000.0,
    drive="rear",
    locked="rear",
)


@pytest.mark.parametrize("config", [load(HMMWV), TRUCK, load("rover")])
def test_parts_together_are_the_vehicle(config):
    made, numbers = chrono_vehicle.files(config), config.vehicle
    json.dumps(made)
    (body,), wheel = made["chassis"]["Components"], made["wheel"]
    corners = [
        made[f"{end}"]["Spindle"]["Mass"] + made[end]["Upright"]["Mass"] + wheel["Mass"]
        + made[f"{end}_tire"]["Mass"]
        for end in ("front", "rear")
    ]  # fmt: skip
    steering = made["steering"]["Steering Link"]["Mass"]
    assert body["Mass"] + 2 * sum(corners) + steering == pytest.approx(numbers.mass, rel=1e-5)
    middle = np.multiply(body["Mass"], body["Centroidal Frame"]["Location"]) / numbers.mass
    np.testing.assert_allclose(middle, numbers.centre_of_mass, atol=1e-4)
    for axle, end in enumerate(("front", "rear")):
        place = made["vehicle"]["Axles"][axle]["Suspension Location"]
        x, y, z = np.add(made[end]["Spindle"]["COM"], place)
        np.testing.assert_allclose([x, y], numbers.wheel_position[2 * axle], atol=1e-3)
        assert abs(z) < 2e-3


def test_the_hmmwv_is_that_of_chrono():
    made = chrono_vehicle.files(load(HMMWV))
    assert made["chassis"]["Components"][0]["Mass"] == pytest.approx(2086.52, rel=1e-3)
    assert made["front"]["Shock"]["Spring Coefficient"] == pytest.approx(167062, rel=1e-3)
    assert made["rear"]["Shock"]["Free Length"] == pytest.approx(0.382, rel=1e-3)


@without
@pytest.mark.parametrize("config", [replace(load(HMMWV), locked="rear"), TRUCK, load("rover")])
def test_it_drives_in_chrono_as_in_the_built_in_simulator(config):
    forward, turning, back = [(4.0, 0.0)] * 40, [(1.5, 0.25)] * 40, [(-2.0, 0.0)] * 40
    seen, expected = (
        drive(simulator, (160.0, 5.0, 3.0), forward + turning + back)
        for simulator in (Chrono(ground(), config), BuiltIn(ground(), config.vehicle))
    )
    for of in (seen, expected):
        assert of.state[0, 2] == pytest.approx(config.vehicle.ride_height, abs=0.04)
        assert of.state[40, 6] == pytest.approx(4.0, abs=0.2)
        assert of.state[-1, 6] == pytest.approx(-2.0, abs=0.2)
    # Chrono's engine takes a moment to begin.
    np.testing.assert_allclose(seen.state[10:40, 6], expected.state[10:40, 6], atol=1.2)
    assert seen.state[78, 11] == pytest.approx(expected.state[78, 11], rel=0.25)


def test_what_chrono_cannot_drive_is_refused():
    with pytest.raises(SimulatorError, match="vehicle: expected one whose front wheels steer"):
        expect(load("husky"))
    with pytest.raises(SimulatorError, match=r"less than its 3.5 kg, found wheel_weight 6 N"):
        expect(replace(load("rover"), wheel_weight=6.0))
