"""Skid-steered vehicles in the built-in simulator: sides that are driven, and tires that slip."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.config import ConfigError
from vertiwm_jax.dynamics import rollout
from vertiwm_jax.errors import UserError
from vertiwm_jax.mechanics import vehicle as vehicles
from vertiwm_jax.mechanics.drivetrain import drive_sides
from vertiwm_jax.mechanics.kinematic import DifferentialDrive, differential_of, place
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import Skid, SkidConfig, Vehicle, VehicleConfig
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap

STEPS = 30
ROBOT = replace(
    vehicles.load("husky"),
    scale=1.0,
    centre_of_mass=(0.0, 0.0, 0.05),
    speed_gain=4.0,
    wheel_torque=15.0,
    brake_torque=15.0,
    wheel_speed_limit=9.0,
    skid=SkidConfig(gain=1.5, speed_lag=0.2, turn_lag=0.5, slip_speed=0.3),
)
"""A robot whose mass lies in the middle."""
GROUND = TerrainMap.from_array(np.zeros((9, 9)), "concrete", resolution=8.0)


def drive(vehicle: Vehicle, speed: float, turn: float) -> VehicleState:
    vehicle, *command = jax.tree.map(jnp.float32, (vehicle, speed, turn))
    return driven_by(vehicle, *command)


@jax.jit
def driven_by(vehicle: Vehicle, speed: jax.Array, turn: jax.Array) -> VehicleState:
    commands = Command(jnp.full(STEPS, speed), jnp.full(STEPS, turn))
    params, start = chrono_like(vehicle), place(GROUND, vehicle=vehicle)
    return rollout(Simulator(), params, GROUND, start, commands)


def with_skid(**changes: float) -> Vehicle:
    assert ROBOT.skid is not None
    return replace(ROBOT, skid=replace(ROBOT.skid, gain=1.0, **changes)).vehicle


def test_it_drives_straight_at_the_commanded_speed_both_ways():
    for speed in (0.5, -0.5):
        driven = drive(with_skid(), speed, 0.0)
        assert float(driven.velocity[-1, 0]) == pytest.approx(speed, abs=0.02)
        np.testing.assert_allclose(driven.rpy[:, 2], 0, atol=1e-4)
        np.testing.assert_allclose(driven.position[:, 1], 0, atol=1e-3)


def test_it_turns_on_the_spot_and_slips():
    vehicle = with_skid(turn_lag=0.1)
    left, right = (drive(vehicle, 0.0, turn) for turn in (1.0, -1.0))
    np.testing.assert_allclose(
        left.angular_velocity[:, 2], -right.angular_velocity[:, 2], atol=1e-3
    )
    np.testing.assert_allclose(left.position[:, :2], 0, atol=0.02)
    # Wheels that cannot steer are dragged sideways, which costs some of the turn.
    assert 0.1 < float(left.angular_velocity[-1, 2]) < 0.9
    firm = replace(vehicle, speed_gain=jnp.float32(100), wheel_torque=jnp.float32(1e3))
    slack = replace(vehicle, speed_gain=vehicle.speed_gain / 4)
    turned = [float(drive(v, 0.0, 1.0).angular_velocity[-1, 2]) for v in (slack, vehicle, firm)]
    assert turned == sorted(turned)


def test_a_turn_at_speed_drifts_outwards():
    driven = drive(with_skid(turn_lag=0.1, slip_speed=0.5), 0.8, 1.5)
    assert float(driven.angular_velocity[-1, 2]) > 0.2
    assert float(driven.velocity[-1, 1]) < -0.01


def test_wheels_are_no_faster_than_their_limit_and_follow_with_the_lag():
    slow = replace(
        with_skid(speed_lag=0.5), wheel_speed_limit=jnp.float32(0.3 / ROBOT.wheel_radius)
    )
    assert float(drive(slow, 1.0, 0.0).velocity[-1, 0]) == pytest.approx(0.3, abs=0.02)
    lagged, prompt = (drive(with_skid(speed_lag=lag), 0.5, 0.0) for lag in (0.8, 0.05))
    assert float(lagged.velocity[4, 0]) < 0.6 * float(prompt.velocity[4, 0])


def test_commands_beyond_the_largest_yaw_rate_are_as_that():
    vehicle = with_skid(turn_lag=0.1)
    limit = float(vehicle.steering_limit)
    there, beyond = (drive(vehicle, 0.0, turn) for turn in (limit, 3 * limit))
    np.testing.assert_allclose(there.rpy, beyond.rpy, atol=1e-5)


def test_a_robot_enlarged_drives_the_same_at_another_scale():
    # 3 s of the robot are 30 steps of a vehicle whose times are as long.
    scale = 2.0
    small, large = (replace(ROBOT, scale=s).vehicle for s in (1.0, scale))
    assert isinstance(large.skid, Skid) and isinstance(small.skid, Skid)
    assert float(large.steering_limit) == pytest.approx(ROBOT.steering_limit / scale**0.5)
    assert float(large.skid.turn_lag) == pytest.approx(float(small.skid.turn_lag) * scale**0.5)
    end, other = drive(small, 0.5, 1.0), drive(large, 0.5 * scale**0.5, 1.0 / scale**0.5)
    assert float(other.velocity[-1, 0]) == pytest.approx(
        float(end.velocity[-1, 0]) * scale**0.5, rel=0.05
    )
    turned = float(other.angular_velocity[-1, 2]) * scale**0.5
    assert turned == pytest.approx(float(end.angular_velocity[-1, 2]), rel=0.05)


def test_torques_are_within_the_pedal_and_differentiable_beyond_it():
    vehicle = with_skid(turn_lag=0.1)
    assert vehicle.skid is not None

    def torque(gain: jax.Array) -> jax.Array:
        skid = replace(vehicle.skid, gain=gain)
        told = Command(jnp.float32(0.8), jnp.float32(0.5))
        at = jnp.float32(0.5), jnp.float32(0.7), jnp.full(4, 2.0)
        found = drive_sides(vehicle, skid, told, *at, seconds=0.02)
        return found.torque - found.brake * at[-1]

    largest = ROBOT.wheel_torque
    assert (np.abs(torque(jnp.float32(50.0))) <= largest * 1.0001).all()
    for gain in (1.0, 1.5):
        slope = jax.jacfwd(torque)(jnp.float32(gain))
        difference = (torque(jnp.float32(gain + 0.01)) - torque(jnp.float32(gain - 0.01))) / 0.02
        np.testing.assert_allclose(slope, difference, rtol=0.02, atol=0.05)


def test_the_kinematic_yardstick_has_the_gain_and_lags_of_the_vehicle():
    vehicle = ROBOT.vehicle
    assert vehicle.skid is not None
    params = differential_of(vehicle)
    commands = Command(jnp.full(STEPS, 0.4), jnp.full(STEPS, 0.5))
    start = place(GROUND, vehicle=vehicle)
    driven = rollout(DifferentialDrive(), params, GROUND, start, commands)
    gain, lag = float(vehicle.skid.gain), float(vehicle.skid.turn_lag)
    expected = gain * 0.5 * (1 - np.exp(-0.1 * STEPS / lag))
    assert float(driven.angular_velocity[-1, 2]) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"drive": "rear"}, "skid: expected drive: all .* found rear"),
        ({"locked": "all"}, "skid: expected .* locked: none .* found all and all"),
    ],
)
def test_what_no_skid_steered_vehicle_has_is_told(change, said):
    with pytest.raises(ConfigError, match=said):
        replace(ROBOT, **change)


def test_lags_and_gains_are_positive_and_finite():
    assert ROBOT.skid is not None
    for bad in (0.0, -1.0, np.inf):
        with pytest.raises(ConfigError, match="turn_lag"):
            replace(ROBOT.skid, turn_lag=bad)


def test_skid_steered_vehicles_are_stacked_alone():
    both = vehicles.stack([ROBOT.vehicle, replace(ROBOT, mass=80.0).vehicle])
    second = both.select(jnp.int32(1))
    assert float(second.mass) == 80.0 and second.skid is not None and ROBOT.skid is not None
    assert float(second.skid.gain) == pytest.approx(ROBOT.skid.gain)
    with pytest.raises(UserError, match="skid-steered"):
        vehicles.stack([ROBOT.vehicle, vehicles.load_vehicle()])


def test_arcs_ahead_are_those_at_the_largest_speed():
    vehicle: VehicleConfig = ROBOT
    fastest = vehicle.wheel_speed_limit * vehicle.wheel_radius
    assert isinstance(fastest, float)
    curvature = float(vehicle.vehicle.curvature(np.float32(0.5)))
    assert curvature == pytest.approx(vehicle.steering_limit / 2 / fastest)
