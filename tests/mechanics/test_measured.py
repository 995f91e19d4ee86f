"""Numbers of a vehicle from what is measured of it, here of vehicles of the simulator."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.config import ConfigError
from vertiwm_jax.dynamics import rollout
from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.mechanics.measured import is_described, measured
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import GRAVITY, VehicleConfig, load
from vertiwm_jax.state import Command
from vertiwm_jax.terrain.map import TerrainMap

ASPHALT = TerrainMap.from_array(np.zeros((129, 129)), "concrete", friction=np.full((8, 8), 0.9))
HMMWV = load("hmmwv")
WEAK = replace(HMMWV, wheel_torque=1500.0, wheel_power=6e3, brake_torque=900.0)


@partial(jax.jit, static_argnums=2)
def _drive(params, commands, start: float):
    state = place(ASPHALT, (-50.0, 0.0), vehicle=params.vehicle, speed=start)
    return rollout(Simulator(), params, ASPHALT, state, commands).velocity[:, 0]


def described(config: VehicleConfig, **changes) -> dict:
    """What a person would measure of a vehicle that drives like the simulator's."""
    params, vehicle = chrono_like(config.vehicle), config.vehicle
    start, stop = (
        np.asarray(_drive(params, Command(jnp.full(40, to), jnp.zeros(40)), begin)).tolist()
        for to, begin in ((8.0, 0.0), (0.0, 8.0))
    )
    angle = config.steering_limit
    load = config.mass * GRAVITY / 4
    facts = {
        "mass": config.mass,
        "inertia": np.diag(config.inertia).tolist(),
        "com_in_body": list(config.centre_of_mass),
        "wheels_in_body_xy": vehicle.wheel_position.tolist(),
        "wheel_radius": vehicle.wheel_radius.tolist(),
        "wheel_width": vehicle.wheel_width.tolist(),
        "wheel_height_at_rest": vehicle.travel_at_rest.tolist(),
        "wheel_load_at_rest": [load] * 4,
        "front_angle": {"0.5": 0.6 * angle, "-0.5": -0.6 * angle, "1.0": angle, "-1.0": -angle},
        "pedal_gain": config.speed_gain,
        "bench": {"start": start, "stop": stop},
        "name": "mine",
    }
    return {**facts, **changes}


@pytest.mark.integration
def test_engine_and_brakes_are_found_from_how_it_starts_and_stops():
    found = measured(described(WEAK, design={"drive": "awd"}), "it")
    # Accelerations are means over 0.3 s, in which the torque has begun to fall.
    assert found.wheel_torque == pytest.approx(WEAK.wheel_torque, rel=0.1)
    assert found.wheel_power == pytest.approx(WEAK.wheel_power, rel=0.1)
    assert found.brake_torque == pytest.approx(WEAK.brake_torque, rel=0.1)
    assert found.wheel_inertia == pytest.approx(WEAK.wheel_inertia, rel=0.05)
    for name in ("mass", "centre_of_mass", "wheelbase", "steering_limit", "speed_gain"):
        assert getattr(found, name) == pytest.approx(getattr(WEAK, name), rel=1e-6)
    assert found.track == pytest.approx([WEAK.track] * 2)
    assert found.wheel_angle == pytest.approx((1.2, 1.0))


def test_springs_that_are_not_known_carry_the_weight_at_the_height_that_is():
    found = measured(described(WEAK), "it").vehicle
    np.testing.assert_allclose(found.travel_at_rest, WEAK.vehicle.travel_at_rest, atol=2e-3)
    sprung = (WEAK.mass * GRAVITY / 4 - found.wheel_weight) / GRAVITY
    np.testing.assert_allclose(np.sqrt(found.spring / sprung) / (2 * np.pi), 2.0, rtol=0.01)


def test_a_data_sheet_counts_more_than_guesses():
    design = {
        "wheel_spring": [1e5, 2e5],
        "wheel_damper": [1e4, 2e4],
        "wheel_torque": 5e3,
        "wheel_power": 3e4,
        "brake_torque": 3e3,
        "drive": "rwd",
        "chassis_box": {"half_length": 1.0, "half_width": 0.4, "underside": 0.1, "roof": 0.6},
    }
    found = measured(described(WEAK, design=design), "it")
    assert found.spring == (1e5, 2e5) and found.damper == (1e4, 2e4)
    assert (found.wheel_torque, found.wheel_power, found.brake_torque) == (5e3, 3e4, 3e3)
    assert found.reverse_torque == pytest.approx(0.43 * 5e3)
    assert found.drive == "rear" and found.hull == (1.0, 0.4, 0.1, 0.6)


@pytest.mark.integration
def test_who_starts_with_half_the_grip_is_taken_for_driven_by_the_rear_wheels():
    assert measured(described(replace(HMMWV, drive="rear")), "it").drive == "rear"
    strong = measured(described(HMMWV), "it")
    assert strong.drive == "all"
    # Tires that slip hide how strong it is: at least as strong as it was seen to be.
    grip = 0.9 * HMMWV.mass * GRAVITY * HMMWV.wheel_radius / 4
    assert strong.wheel_torque > grip and strong.brake_torque > grip


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mass": -3.0}, "mass: expected more than 0, found -3.0"),
        ({"wheel_load_at_rest": [1.0, 2.0]}, "expected a description, found: ValueError"),
        ({"bench": {"start": [0.1]}}, "expected a description, found: KeyError: 'stop'"),
    ],
)
def test_what_describes_no_vehicle_is_told_in_one_line(changes, words):
    with pytest.raises(ConfigError) as refused:
        measured(described(WEAK, **changes), "a.npz: meta.vehicle")
    assert str(refused.value).startswith("a.npz: meta.vehicle: ") and words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_names_and_geometry_alone_are_no_description():
    facts = described(WEAK)
    assert is_described(facts) and not is_described(None)
    assert not is_described({name: x for name, x in facts.items() if name != "bench"})
