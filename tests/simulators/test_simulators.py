"""Every simulator outside jit keeps the same protocol."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vertiwm_jax.dynamics import rollout
from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import GRAVITY, load_vehicle
from vertiwm_jax.simulators import chrono
from vertiwm_jax.simulators.builtin import BuiltIn
from vertiwm_jax.simulators.chrono import Chrono
from vertiwm_jax.simulators.protocol import SimulatorError
from vertiwm_jax.state import Command
from vertiwm_jax.terrain.map import TerrainMap

CONCRETE, SAND, SNOW = 1, 8, 9
WEIGHT = float(load_vehicle().mass) * GRAVITY


def installed():
    try:
        chrono.modules()
    except SimulatorError:
        return False
    return True


without = pytest.mark.skipif(not installed(), reason="PyChrono is not installed")
SIMULATORS = [BuiltIn, pytest.param(Chrono, marks=without)]
CREEP = {BuiltIn: 0.05, Chrono: 0.4}
"""m/s at which brakes let a vehicle down a slope of 0.1: those of Chrono hold it no better."""


def ground(west=CONCRETE, east=CONCRETE, slope=0.0, origin=(100.0, 64.0)):
    """128 m x 128 m that rises to the east, of one class on either side; not about (0, 0)."""
    elevation = np.broadcast_to(slope * np.arange(129.0), (129, 129))
    semantic = np.full((16, 16), west)
    semantic[:, 8:] = east
    friction = np.full((16, 16), 0.8)
    return TerrainMap.from_array(elevation, semantic, friction=friction, origin=origin)


def drive(simulator, start, commands):
    """The observations of a drive, leaves `[T + 1, ...]`."""
    seen = [simulator.start(*start), *map(simulator.step, commands)]
    return jax.tree.map(lambda *x: np.stack(x), *seen)


@pytest.mark.parametrize("kind", SIMULATORS)
@pytest.mark.integration
def test_a_start_is_at_rest(kind):
    seen = kind(ground(slope=0.1)).start(150.0, 5.0, 1.0)
    slope, creep = np.arctan(0.1), CREEP[kind]
    np.testing.assert_allclose(seen.state[:2], [150.0, 5.0], atol=0.05 + creep)
    assert 0.3 < seen.state[2] - 5.0 < 0.6
    np.testing.assert_allclose(seen.state[3], -slope * np.sin(1.0), atol=0.03)
    np.testing.assert_allclose(seen.state[4], -slope * np.cos(1.0), atol=0.03)
    np.testing.assert_allclose(seen.state[5], 1.0, atol=0.05)
    np.testing.assert_allclose(seen.state[6:], 0.0, atol=creep)
    assert seen.state.shape == (12,) and np.all(seen.wheel_class == CONCRETE)
    wheels = seen.wheels
    np.testing.assert_allclose(wheels.wheel_sinkage, 0.0, atol=0.02)
    np.testing.assert_allclose(wheels.wheel_omega, 0.0, atol=3 * creep)
    np.testing.assert_allclose(wheels.wheel_force.sum(0), [0, 0, WEIGHT], atol=0.03 * WEIGHT)


@pytest.mark.parametrize("kind", SIMULATORS)
def test_commands_are_followed_and_wheels_roll(kind):
    commands = np.tile([3.0, 0.2], (60, 1))
    seen = drive(kind(ground()), (164.0, 0.0, 0.0), commands)
    last = jax.tree.map(lambda x: x[-1], seen)
    speed, yaw_rate = last.state[6], last.state[11]
    assert 2.0 < speed < 3.1
    np.testing.assert_allclose(yaw_rate, speed * np.tan(0.2) / 3.302, rtol=0.2)
    np.testing.assert_allclose(last.wheels.steer_angle, 0.2, atol=0.05)
    np.testing.assert_allclose(last.wheels.wheel_omega.mean(), speed / 0.467, rtol=0.1)
    # Turning left, the ground pushes inwards with m v omega.
    force, yaw = last.wheels.wheel_force.sum(0), last.state[5]
    inwards = -np.sin(yaw) * force[0] + np.cos(yaw) * force[1]
    np.testing.assert_allclose(inwards, WEIGHT / GRAVITY * speed * yaw_rate, rtol=0.3)
    # v_body is how the position moves.
    moved = np.linalg.norm(np.diff(seen.state[-11:, :2], axis=0), axis=-1).sum()
    np.testing.assert_allclose(
        moved, np.linalg.norm(seen.state[-11:, 6:8], axis=-1).mean(), rtol=0.05
    )


@pytest.mark.parametrize("kind", SIMULATORS)
def test_wheels_sink_into_soil_alone(kind):
    seen = drive(kind(ground(east=SNOW)), (155.0, 0.0, 0.0), np.tile([3.0, 0.0], (70, 1)))
    assert np.all(seen.wheel_class[0] == CONCRETE) and np.all(seen.wheel_class[-1] == SNOW)
    sinkage = seen.wheels.wheel_sinkage
    assert np.all(np.abs(sinkage[0]) < 0.02) and np.all(sinkage[-1] > 0.01)
    assert np.all(sinkage[-1] < 0.3)


@pytest.mark.parametrize("kind", SIMULATORS)
def test_a_start_forgets_the_drive_before(kind):
    simulator, start, commands = kind(ground(slope=0.1)), (160.0, 5.0, 1.0), np.ones((5, 2)) * 0.2
    first, again = (drive(simulator, start, commands) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first, again)


@pytest.mark.parametrize("kind", SIMULATORS)
def test_a_push_moves_the_whole_vehicle(kind):
    commands, pushed = np.tile([3.0, 0.1], (10, 1)), np.array([0.02, -0.01, 0.0])
    simulator, start = kind(ground()), (160.0, 5.0, 1.0)
    straight = drive(simulator, start, commands)
    simulator.start(*start)
    for command in commands[:6]:
        simulator.step(command)
    simulator.push(np.array([0.3, -0.2, 0.0]), pushed)
    after = [simulator.step(command).state for command in commands[6:]]
    # It goes on as it would have, from where it is; what the push adds soon goes into the tires.
    apart = np.array(after) - straight.state[7:]
    np.testing.assert_allclose(apart[:, :3], np.tile([0.3, -0.2, 0.0], (4, 1)), atol=0.006)
    np.testing.assert_allclose(apart[:, 3:6], 0.0, atol=0.01)
    assert np.linalg.norm(apart[0, :3] - [0.3, -0.2, 0.0]) > 1e-5
    simulator.start(*start)
    for command in commands[:6]:
        simulator.step(command)
    simulator.push(np.zeros(3), np.zeros(3))
    np.testing.assert_array_equal(simulator.step(commands[6]).state, straight.state[7])


@pytest.mark.integration
def test_the_built_in_simulator_is_the_one_inside_jit():
    terrain, model, params = ground(slope=0.1, east=SAND), Simulator(), chrono_like(load_vehicle())
    commands = np.random.default_rng(0).uniform([1, -0.3], [4, 0.3], (40, 2)).astype(np.float32)
    seen = drive(BuiltIn(terrain), (160.0, 5.0, 1.0), commands)

    @jax.jit
    def inside(commands):
        start = place(terrain, jnp.array([160.0, 5.0]), jnp.float32(1.0))
        return rollout(model, params, terrain, start, commands)

    commands = np.concatenate([np.zeros((15, 2), np.float32), commands])
    states = inside(Command.from_vector(jnp.asarray(commands))).vector
    np.testing.assert_allclose(seen.state, states[14:], atol=1e-3)


def test_forces_of_the_built_in_simulator_are_what_moves_it():
    mass, centre = float(load_vehicle().mass), np.asarray(load_vehicle().centre_of_mass)
    commands = np.tile([[4.0, 0.3], [4.0, -0.3]], (1, 20)).reshape(-1, 2)
    # Up a slope, with its belly on a ridge between the wheels.
    terrain = ground(slope=0.3)
    terrain = replace(terrain, elevation=terrain.elevation.at[0, 59].add(0.8))
    seen = drive(BuiltIn(terrain), (160.0, 5.0, 0.0), commands)
    rotation = Rotation.from_euler("ZYX", seen.state[:, 5:2:-1]).as_matrix()
    velocity = seen.state[:, 6:9] + np.cross(seen.state[:, 9:], centre)
    momentum = mass * np.einsum("tij,tj->ti", rotation, velocity)
    force = seen.wheels.wheel_force.sum(1) + seen.wheels.chassis_force
    found = 0.1 * (force[1:] - [0, 0, WEIGHT])
    np.testing.assert_allclose(found, np.diff(momentum, axis=0), atol=0.003 * WEIGHT)
    assert np.abs(seen.wheels.chassis_force).max() > 0.1 * WEIGHT


@without
def test_obstacles_stand_in_the_way_in_chrono():
    terrain = replace(ground(), obstacles=jnp.array([[[160.0, 0.0, 2.0, 8.0, 3.0]]]))
    seen = drive(Chrono(terrain), (145.0, 0.0, 0.0), [(3.0, 0.0)] * 60)
    # Front wheels, as far as 2.1 m before the origin, meet the box, whose near side is at 159 m.
    np.testing.assert_allclose(seen.state[-10:, 0], 156.9, atol=0.2)
    np.testing.assert_allclose(seen.state[-1, 6], 0.0, atol=0.3)


@pytest.mark.skipif(installed(), reason="PyChrono is installed")
def test_without_pychrono_it_is_said_where_it_comes_from():
    with pytest.raises(SimulatorError, match="conda install -c projectchrono") as refused:
        Chrono(ground())
    assert "PyPI is something else" in str(refused.value) and "\n" not in str(refused.value)
