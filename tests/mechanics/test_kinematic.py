from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from vertiwm_jax.dynamics import rollout, warm_up
from vertiwm_jax.mechanics.kinematic import (
    BicycleParams,
    ConstantVelocity,
    DifferentialDrive,
    DifferentialParams,
    KinematicBicycle,
    place,
)
from vertiwm_jax.state import STEP_SECONDS, Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap

PARAMS = BicycleParams(
    wheelbase=jnp.float32(3.302),
    track=jnp.float32(1.82),
    ride_height=jnp.float32(0.45),
    speed_lag=jnp.float32(0.3),
)


def plane(rise_x: float, rise_y: float) -> TerrainMap:
    x = np.arange(65) - 32.0
    heights = 50 + rise_x * x[None, :] - rise_y * x[:, None]
    return TerrainMap.from_array(heights, np.full((8, 8), 3))


def matrix(state: VehicleState) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", np.asarray(state.rpy)[::-1]).as_matrix()
    pose[:3, 3] = state.position
    return pose


def test_constant_velocity_is_the_exponential_of_the_twist():
    rng = np.random.default_rng(0)
    step = jax.jit(ConstantVelocity().step)
    for scale in (1e-4, 1e-2, 1.0):
        state = VehicleState.from_vector(
            jnp.asarray(np.r_[rng.normal(size=9), scale * rng.normal(size=3)], jnp.float32)
        )
        after, _ = step(None, plane(0, 0), (), state, Command.from_vector(jnp.zeros(2)))
        v, w = np.asarray(state.velocity), np.asarray(state.angular_velocity)
        twist = np.zeros((4, 4))
        twist[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
        twist[:3, 3] = v
        expected = matrix(state) @ expm(STEP_SECONDS * twist)
        np.testing.assert_allclose(matrix(after), expected, atol=2e-6)
        np.testing.assert_array_equal(after.velocity, state.velocity)


@pytest.mark.parametrize("steering", [0.1, 0.35, -0.35])
def test_bicycle_drives_a_circle(steering):
    ground, steps, speed = plane(0, 0), 100, 2.0
    state = VehicleState.from_vector(jnp.zeros(12).at[2].set(50.45).at[6].set(speed))
    commands = Command(jnp.full(steps, speed), jnp.full(steps, steering))
    driven = rollout(KinematicBicycle(), PARAMS, ground, state, commands)

    x, y = np.asarray(driven.position[20:, :2], np.float64).T
    centre_x, centre_y, c = np.linalg.lstsq(
        np.stack([2 * x, 2 * y, np.ones_like(x)], axis=1), x**2 + y**2, rcond=None
    )[0]
    radius = np.sqrt(c + centre_x**2 + centre_y**2)
    # The rear axle turns at wheelbase / tan(steering); the origin half a wheelbase ahead of it.
    wheelbase = float(PARAMS.wheelbase)
    expected = np.hypot(wheelbase / np.tan(steering), wheelbase / 2)
    assert radius == pytest.approx(expected, rel=1e-2)
    # The commanded speed is that along the body, which is the rear axle's.
    yaw_rate = speed * np.tan(steering) / wheelbase
    assert float(driven.angular_velocity[-1, 2]) == pytest.approx(yaw_rate, rel=1e-4)
    course_speed = np.hypot(driven.velocity[-1, 0], driven.velocity[-1, 1])
    assert course_speed == pytest.approx(abs(yaw_rate) * expected, rel=1e-4)
    assert float(driven.velocity[-1, 0]) == pytest.approx(speed, rel=1e-4)


def test_differential_drive_turns_on_the_spot_and_follows_shares_of_its_commands():
    numbers = 0.5, 0.6, 0.45, 0.8, 0.25, 0.1, 0.2, 0.0, 0.0
    params = DifferentialParams(*map(jnp.float32, numbers))
    state = VehicleState.from_vector(jnp.zeros(12).at[2].set(50.45))
    turn = Command(jnp.zeros(20), jnp.full(20, 2.0))
    turned = rollout(DifferentialDrive(), params, plane(0, 0), state, turn)
    np.testing.assert_allclose(turned.position[:, :2], 0, atol=1e-6)
    rate = 0.5 * (1 - np.exp(-0.1 * np.arange(1, 21) / 0.2))
    np.testing.assert_allclose(turned.angular_velocity[:, 2], rate, rtol=1e-4)
    np.testing.assert_allclose(turned.rpy[-1, 2], 0.1 * rate.sum(), rtol=1e-4)
    ahead = Command(jnp.full(20, -1.0), jnp.zeros(20))
    driven = rollout(DifferentialDrive(), params, plane(0, 0), state, ahead)
    speed = -0.8 * (1 - np.exp(-np.arange(1, 21)))
    np.testing.assert_allclose(driven.velocity[:, 0], speed, rtol=1e-4)
    np.testing.assert_allclose(driven.position[-1, 0], 0.1 * speed.sum(), rtol=1e-4)


def test_differential_drive_drifts_outwards_and_turns_about_its_offset():
    numbers = 0.5, 0.6, 0.45, 1.0, 1.0, 0.01, 0.01, 0.1, 0.2
    params = DifferentialParams(*map(jnp.float32, numbers))
    state = VehicleState.from_vector(jnp.zeros(12).at[2].set(50.45))
    for turn in (0.5, -0.5):
        command = Command(jnp.full(5, 2.0), jnp.full(5, turn))
        driven = rollout(DifferentialDrive(), params, plane(0, 0), state, command)
        np.testing.assert_allclose(driven.velocity[-1, 1], turn * (0.1 - 0.2 * 2), rtol=1e-4)


def test_bicycle_approaches_the_commanded_speed_with_its_lag():
    state = VehicleState.from_vector(jnp.zeros(12).at[2].set(50.45))
    commands = Command(jnp.full(3, 3.0), jnp.zeros(3))
    driven = rollout(KinematicBicycle(), PARAMS, plane(0, 0), state, commands)
    np.testing.assert_allclose(driven.velocity[:, 0], 3 * (1 - np.exp([-1 / 3, -2 / 3, -1])), 1e-5)


def test_bicycle_climbs_at_its_speed_along_the_slope():
    ground = plane(0.5, 0.0)
    state = place(ground, vehicle=PARAMS, speed=2.0)
    commands = Command(jnp.full(50, 2.0), jnp.zeros(50))
    driven = rollout(KinematicBicycle(), PARAMS, ground, state, commands)
    along = np.linalg.norm(np.asarray(driven.position[-1] - state.position))
    assert along == pytest.approx(10.0, rel=1e-3)


@pytest.mark.parametrize("yaw", [0.0, 0.7, np.pi / 2, -2.5])
@pytest.mark.parametrize("rise", [(0.3, 0.0), (0.0, 0.3), (-0.2, 0.25)])
def test_rest_on_a_plane_is_exact(rise, yaw):
    state = place(plane(*rise), (1.3, -2.7), yaw, vehicle=PARAMS)
    position, rpy = state.position, state.rpy
    body = Rotation.from_euler("ZYX", np.asarray(rpy)[::-1]).as_matrix()
    normal = np.array([-rise[0], -rise[1], 1.0])
    normal /= np.linalg.norm(normal)
    np.testing.assert_allclose(body[:, 2], normal, atol=2e-3)
    assert float(rpy[2]) == pytest.approx(yaw, abs=1e-6)
    foot = np.array([1.3, -2.7, 50 + rise[0] * 1.3 - rise[1] * 2.7])
    above = (np.asarray(position) - foot) @ normal
    assert above == pytest.approx(float(PARAMS.ride_height), abs=1e-3)


def test_positive_pitch_is_nose_down_and_positive_roll_is_right_side_down():
    def at_rest(ground: TerrainMap) -> np.ndarray:
        return np.asarray(place(ground, vehicle=PARAMS).rpy)

    np.testing.assert_allclose(at_rest(plane(-0.3, 0.0)), [0, np.arctan(0.3), 0], atol=1e-5)
    np.testing.assert_allclose(at_rest(plane(0.0, 0.3)), [np.arctan(0.3), 0, 0], atol=1e-5)


def test_warm_up_replays_the_recorded_states():
    """It has seen each recorded state with the command that follows, and the ground there."""

    @struct.dataclass
    class Pages:
        features: Any
        written: jax.Array

    class Diary:
        """Errs by a meter in each step, and writes down what it is given, and where it looks."""

        def init(self, params, terrain, state):
            return Pages(self.see(params, terrain, state), jnp.zeros(3))

        def see(self, params, terrain, state):
            return state.position[0]

        def step(self, params, terrain, history, state, command):
            read = jnp.stack([state.position[0], command.speed, history.features])
            state = replace(state, position=state.position + 1)
            return state, Pages(self.see(params, terrain, state), 10 * history.written + read)

    states = jax.vmap(lambda i: VehicleState.from_vector(jnp.full(12, i)))(
        jnp.arange(1.0, 9.0, 2.0)
    )
    history = warm_up(Diary(), None, plane(0, 0), states, Command(jnp.arange(3.0), jnp.zeros(3)))
    np.testing.assert_array_equal(history.written, [135.0, 12.0, 135.0])
    assert history.features == 7.0
