from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vertiwm_jax.dynamics import rollout
from vertiwm_jax.mechanics.bekker_wong import BekkerWongParams
from vertiwm_jax.mechanics.drivetrain import SPIN_FLOOR
from vertiwm_jax.mechanics.kinematic import bicycle_of, place
from vertiwm_jax.mechanics.simulator import (
    Simulator,
    SimulatorHistory,
    SimulatorParams,
    chrono_like,
)
from vertiwm_jax.mechanics.vehicle import GRAVITY, load, load_vehicle, stack
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap

CONCRETE, MUD, SAND, SNOW = 1, 7, 8, 9
STEPS = 50
VEHICLE = load_vehicle()
PARAMS = chrono_like(VEHICLE)
SIZES = replace(bicycle_of(VEHICLE), ride_height=jnp.float32(0.43))
WEIGHT = float(VEHICLE.mass) * GRAVITY
SIMULATOR = Simulator()

Height = Callable[[np.ndarray, np.ndarray], np.ndarray]


class Drive(NamedTuple):
    """States and histories after each step, NumPy leaves `[T, ...]`."""

    state: VehicleState
    history: SimulatorHistory


def ground(
    height: Height = lambda x, y: 0 * x,
    kind: int = CONCRETE,
    friction: float = 0.8,
    centre: tuple[float, float] = (0.0, 0.0),
) -> TerrainMap:
    """64 m x 64 m of one class about `centre`."""
    c = np.arange(65) - 32.0
    x, y = np.meshgrid(c, -c)
    return TerrainMap.from_array(
        height(x, y),
        np.full((8, 8), kind),
        friction=np.full((8, 8), friction),
        origin=(centre[0] - 32, centre[1] + 32),
    )


def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.4 * np.sin(0.5 * x + 0.3) + 0.3 * np.sin(0.7 * y) + 0.05 * x


def at_rest(terrain: TerrainMap, x: float = 0, y: float = 0, yaw: float = 0) -> VehicleState:
    return place(terrain, (x, y), yaw, vehicle=SIZES)


@jax.jit
def advance(
    params: SimulatorParams,
    terrain: TerrainMap,
    history: SimulatorHistory,
    state: VehicleState,
    commands: Command,
) -> tuple[VehicleState, SimulatorHistory]:
    def step(carry, command):
        carry = SIMULATOR.step(params, terrain, carry[1], carry[0], command)
        return carry, carry

    return jax.lax.scan(step, (state, history), commands)[1]


def drive(
    terrain: TerrainMap,
    state: VehicleState,
    speed: float = 0.0,
    steering: float = 0.0,
    params: SimulatorParams = PARAMS,
    seconds: int = 5,
) -> Drive:
    """Holds a command, in pieces of `STEPS` so that everything is one compiled program."""
    history, parts = SIMULATOR.init(params, terrain, state), []
    commands = Command(jnp.full(STEPS, float(speed)), jnp.full(STEPS, float(steering)))
    for _ in range(seconds * 10 // STEPS):
        states, histories = advance(params, terrain, history, state, commands)
        state, history = jax.tree.map(lambda leaf: leaf[-1], (states, histories))
        parts.append((states, histories))
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return Drive(*joined)


def loads(driven: Drive) -> np.ndarray:
    """`[T, 4]` N on the ground, from the springs of a vehicle at rest."""
    compressed = driven.history.travel - np.asarray(VEHICLE.free_travel)
    return np.asarray(VEHICLE.spring) * compressed + float(VEHICLE.wheel_weight)


def energy(state: VehicleState) -> np.ndarray:
    """`[T]` J of the body: motion and height."""
    centre = np.asarray(VEHICLE.centre_of_mass)
    velocity = state.velocity + np.cross(state.angular_velocity, centre)
    body = Rotation.from_euler("ZYX", np.asarray(state.rpy)[:, ::-1])
    height = state.position[:, 2] + body.apply(centre)[:, 2]
    spin = (state.angular_velocity**2 * np.asarray(VEHICLE.inertia)).sum(-1)
    return 0.5 * float(VEHICLE.mass) * (velocity**2).sum(-1) + 0.5 * spin + WEIGHT * height


@pytest.mark.integration
def test_settles_on_flat_ground_under_its_weight():
    flat = ground()
    driven = drive(flat, at_rest(flat))
    still = driven.state.position[-20:]
    assert np.ptp(still[:, 2]) < 1e-4
    assert np.ptp(still[:, 0]) < 0.02
    assert loads(driven)[-1].sum() == pytest.approx(WEIGHT, rel=2e-3)
    # Moments about the front axle: the rear one carries its share of the weight.
    share = 0.5 - float(VEHICLE.centre_of_mass[0]) / float(VEHICLE.wheelbase)
    assert loads(driven)[-1, 2:].sum() == pytest.approx(share * WEIGHT, rel=0.02)


def test_does_not_rock_at_rest():
    flat = ground()
    driven = drive(flat, at_rest(flat))
    assert np.abs(driven.state.velocity[-20:]).max() < 4e-3
    assert np.abs(driven.history.wheel_speed[-20:]).max() < 0.02


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_reaches_the_commanded_speed(speed):
    flat = ground()
    driven = drive(flat, at_rest(flat, x=-15), speed)
    assert driven.state.velocity[-1, 0] == pytest.approx(speed, rel=0.03)
    rolled = driven.history.wheel_speed[-1] * float(VEHICLE.wheel_radius)
    np.testing.assert_allclose(rolled, speed, rtol=0.03)


def test_drives_backwards():
    flat = ground()
    driven = drive(flat, at_rest(flat, x=15), -2.0, 0.2)
    assert driven.state.velocity[-1, 0] == pytest.approx(-2.0, rel=0.03)
    # The front wheels lead the tail to their other side.
    radius = driven.state.velocity[-1, 0] / driven.state.angular_velocity[-1, 2]
    assert radius == pytest.approx(float(VEHICLE.wheelbase) / np.tan(0.2), rel=0.08)


def test_reverse_gear_may_have_a_torque_of_its_own():
    flat, own = ground(), replace(load("hmmwv"), reverse_torque=1000.0)
    start, vehicles = at_rest(flat), [own.vehicle, load("hmmwv").vehicle]
    alone = drive(flat, start, -6.0, params=chrono_like(own.vehicle)).state.velocity[:, 0]
    radius = own.wheel_radius
    inertia = own.mass + 4 * own.wheel_inertia / radius**2
    gained = (alone[7] - alone[2]) / 0.5
    assert gained == pytest.approx(-4 * 1000 / radius / inertia, rel=0.05)
    # Beside it, one without is driven as forward, as it is when it is alone.
    several = stack(vehicles)
    together, free = (
        drive(flat, start, -6.0, params=chrono_like(vehicle)).state.velocity[:, 0]
        for vehicle in (several.select(jnp.int32(1)), vehicles[1])
    )
    np.testing.assert_allclose(together, free, atol=1e-4)
    assert free[2] < 2 * alone[2]


@pytest.mark.parametrize(("before", "after"), [(6.0, -2.0), (-6.0, 2.0)])
def test_brakes_until_the_gear_can_be_shifted(before, after):
    """With weak brakes, as a vehicle that uses its engine stops sooner."""
    weak = replace(PARAMS, vehicle=replace(VEHICLE, brake_torque=jnp.float32(600.0)))
    flat, gears = ground(), np.sign([before, after])
    start = replace(at_rest(flat, x=-3 * before), velocity=jnp.array([before, 0.0, 0.0]))
    history = SIMULATOR.init(weak, flat, start)
    history = replace(history, gear=jnp.float32(gears[0]))
    commands = Command(jnp.full(STEPS, after), jnp.zeros(STEPS))
    states, histories = advance(weak, flat, history, start, commands)
    speed, gear = (np.asarray(x) for x in (states.velocity[:, 0], histories.gear))
    assert gear[0] == gears[0] and gear[-1] == gears[1]
    shifted = np.argmax(gear == gears[1])
    # Four brakes stop the mass and the spin of the wheels, the less the slower these are.
    radius = float(VEHICLE.wheel_radius)
    spin = np.abs(speed[1:shifted] + speed[: shifted - 1]) / 2 / radius
    inertia = float(VEHICLE.mass) + 4 * float(VEHICLE.wheel_inertia) / radius**2
    expected = -gears[0] * 4 * 600 / radius * spin / (spin + SPIN_FLOOR) / inertia
    np.testing.assert_allclose(np.diff(speed)[3:20] / 0.1, expected[3:20], rtol=0.02)
    assert speed[-1] == pytest.approx(after, rel=0.1)
    assert abs(speed[shifted - 1]) < 0.6


def test_a_vehicle_that_rolls_back_in_forward_gear_drives_on():
    flat = ground()
    start = replace(at_rest(flat), velocity=jnp.array([-2.0, 0.0, 0.0]))
    driven = drive(flat, start, 3.0)
    assert (driven.history.gear == 1).all()
    assert driven.history.force[2, :, 1].sum() > 0.5 * WEIGHT


@pytest.mark.parametrize("steering", [0.1, -0.2, 0.35])
def test_turns_about_the_centre_of_the_bicycle(steering):
    flat = ground()
    state = drive(flat, at_rest(flat), 2.0, steering).state
    radius = state.velocity[-1, 0] / state.angular_velocity[-1, 2]
    assert radius == pytest.approx(float(VEHICLE.wheelbase) / np.tan(steering), rel=0.05)


def test_braking_stops_within_friction():
    flat = ground()
    start = replace(at_rest(flat, x=-20), velocity=jnp.array([6.0, 0, 0]))
    state = drive(flat, start).state
    assert abs(state.velocity[-1, 0]) < 0.02
    assert state.position[-1, 0] + 20 > 6.0**2 / (2 * 0.8 * GRAVITY)
    assert state.position[-1, 0] + 20 < 4.0


@pytest.mark.parametrize("yaw", [0.0, np.pi])
def test_on_a_slope_the_pedal_of_a_standing_vehicle_balances_gravity(yaw):
    slope = ground(lambda x, y: 0.2 * x)
    state = drive(slope, at_rest(slope, yaw=yaw)).state
    # A proportional controller holds with the speed error that gives the pedal it needs.
    pull = WEIGHT * np.sin(np.arctan(0.2)) * float(VEHICLE.wheel_radius) / 4
    # Uphill it drives; downhill it brakes, and a slow wheel only creeps against the brake.
    error = pull / float(VEHICLE.wheel_torque)
    if yaw == 0:
        assert -state.velocity[-1, 0] == pytest.approx(error, rel=0.05)
    assert np.abs(state.velocity[-1, 0]) < 0.3
    assert np.abs(state.velocity[-1, 1:]).max() < 0.05


def test_stands_across_a_slope():
    slope = ground(lambda x, y: 0.2 * x)
    state = drive(slope, at_rest(slope, yaw=np.pi / 2)).state
    # Regularised friction creeps at tan(slope) / friction of the adhesion speed.
    assert np.linalg.norm(state.position[-1] - state.position[-11]) < 0.04
    assert state.rpy[-1, 0] == pytest.approx(-np.arctan(0.2), abs=0.03)


def test_remembers_what_the_ground_did_to_each_wheel():
    slope = ground(lambda x, y: 0.2 * x, SAND)
    across = drive(slope, at_rest(slope, yaw=np.pi / 2)).history
    normal, along, side = across.force[-1].T
    assert normal.sum() == pytest.approx(WEIGHT * np.cos(np.arctan(0.2)), rel=0.01)
    # Uphill is to the right.
    assert side.sum() == pytest.approx(-WEIGHT * np.sin(np.arctan(0.2)), rel=0.05)
    assert np.abs(along.sum()) < 0.01 * WEIGHT
    assert across.wheels.soft[-1].all()
    # In the body, which leans as the ground does.
    np.testing.assert_allclose(across.wheels.normal.z[-1], 1, atol=1e-3)


def test_friction_limits_what_it_climbs():
    rise = np.tan(np.radians(20))
    icy, rough = (ground(lambda x, y: rise * x, friction=mu) for mu in (0.2, 0.8))
    assert drive(icy, at_rest(icy), 4.0).state.position[-1, 0] < -1.0
    assert drive(rough, at_rest(rough), 4.0).state.velocity[-1, 0] == pytest.approx(4.0, rel=0.05)


def test_sinks_deeper_into_weaker_soil():
    depths = []
    for kind in (SAND, MUD, SNOW):
        soil = ground(kind=kind)
        driven = drive(soil, at_rest(soil))
        assert loads(driven)[-1].sum() == pytest.approx(WEIGHT, rel=0.01)
        depths.append(driven.history.sinkage[-1].mean())
    assert 0 < depths[0] < depths[1] < depths[2] < 0.3


def test_soil_slows_a_vehicle_down():
    speeds = []
    for kind in (CONCRETE, SAND, SNOW):
        terrain = ground(kind=kind)
        speeds.append(drive(terrain, at_rest(terrain, x=-10), 3.0).state.velocity[-1, 0])
    assert speeds[0] > speeds[1] > speeds[2] > 1.5


@pytest.mark.parametrize("kind", [SAND, MUD, SNOW])
def test_wongs_wheel_also_stands_and_drives_on_soil(kind):
    wong, soil = replace(PARAMS, contact=BekkerWongParams()), ground(kind=kind)
    standing = drive(soil, at_rest(soil), params=wong)
    # In snow, into which it sinks deep, it still bounces by 2 % of its weight.
    assert loads(standing)[-20:].sum(axis=1).mean() == pytest.approx(WEIGHT, rel=0.01)
    assert standing.history.sinkage[-1].min() > 0
    driven = drive(soil, at_rest(soil, x=-10), 3.0, params=wong)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((standing, driven)))
    # In this snow compaction resists the wheels more than shear can pull.
    assert (driven.state.velocity[-1, 0] > 2.5) == (kind != SNOW)


def test_left_and_right_are_the_same():
    """Soil, which is bilinear: the triangles of rigid ground have a handedness."""
    soil, mirrored = ground(waves, MUD), ground(lambda x, y: waves(x, -y), MUD)
    one = drive(soil, at_rest(soil, y=1.0, yaw=0.3), 3.0, 0.2).state
    other = drive(mirrored, at_rest(mirrored, y=-1.0, yaw=-0.3), 3.0, -0.2).state
    flip = np.array([1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1])
    np.testing.assert_allclose(one.vector, other.vector * flip, atol=0.02)


@pytest.mark.integration
def test_every_wheel_may_be_of_its_own():
    names = ("wheel_radius", "wheel_width", "wheel_inertia", "wheel_torque", "brake_torque")
    own = {name: jnp.broadcast_to(getattr(VEHICLE, name), 4) for name in names}
    params = replace(PARAMS, vehicle=replace(VEHICLE, **own))
    terrain = ground(waves)
    expected, found = (
        drive(terrain, at_rest(terrain), 3.0, 0.2, which) for which in (PARAMS, params)
    )
    np.testing.assert_allclose(found.state.vector, expected.state.vector, atol=1e-4)
    at_the_back = own["wheel_torque"] * jnp.array([0.0, 0.0, 1.0, 1.0])
    driven = replace(params, vehicle=replace(params.vehicle, wheel_torque=at_the_back))
    level = ground()
    pull = drive(level, at_rest(level), 3.0, params=driven).history.force[5, :, 1]
    assert (pull[:2] < 1).all() and (pull[2:] > 100).all()


def of_layout(**layout: str) -> SimulatorParams:
    return chrono_like(replace(load("hmmwv"), **layout).vehicle)


@pytest.mark.parametrize(
    ("layout", "one_speed"),
    [
        ({"locked": "all"}, [(0, 1), (1, 2), (2, 3)]),
        ({"locked": "rear"}, [(2, 3)]),
        ({"drive": "front", "locked": "front"}, [(0, 1)]),
    ],
)
def test_locked_wheels_turn_at_one_speed(layout, one_speed):
    terrain = ground(waves)
    spin = drive(terrain, at_rest(terrain), 3.0, 0.3, of_layout(**layout)).history.wheel_speed
    pairs = [(0, 1), (1, 2), (2, 3)]
    apart = {pair: np.abs(spin[:, pair[0]] - spin[:, pair[1]]).max() for pair in pairs}
    assert all((apart[pair] < 1e-4) == (pair in one_speed) for pair in pairs), apart


@pytest.mark.parametrize(("drive_of", "driven"), [("rear", [2, 3]), ("front", [0, 1])])
def test_the_engine_drives_the_wheels_of_its_axle_alone(drive_of, driven):
    flat = ground()
    pull = drive(flat, at_rest(flat), 3.0, params=of_layout(drive=drive_of)).history.force[5, :, 1]
    assert (pull[driven] > 100).all() and (np.delete(pull, driven) < 1).all()


@pytest.mark.parametrize(("command", "wheels"), [(0.18, 0.225), (0.36, 0.36), (-0.18, -0.225)])
def test_front_wheels_turn_as_their_steering_does(command, wheels):
    """As ones without a law of their own do that are told the angle."""
    flat, own = ground(), replace(load("hmmwv"), steering_limit=0.36)
    law, none = (chrono_like(x.vehicle) for x in (replace(own, wheel_angle=(1.25, 1.0)), own))
    found, expected = (
        drive(flat, at_rest(flat), 2.0, angle, params).state.angular_velocity[-1, 2]
        for angle, params in ((command, law), (wheels, none))
    )
    assert found == pytest.approx(expected, rel=2e-3)


@pytest.mark.integration
def test_a_locked_vehicle_pulls_with_the_wheels_that_have_grip():
    """On a slope, with ice below the rear wheels: one that is open spins there and slides back."""
    friction = np.tile(np.where(np.arange(64) < 32, 0.02, 0.8), (64, 1))
    heights = np.tile(0.25 * (np.arange(65) - 32.0), (65, 1))
    slope = TerrainMap.from_array(heights, "concrete", friction=friction)
    params = of_layout(), of_layout(locked="all")
    free, locked = (drive(slope, at_rest(slope), 2.0, params=each) for each in params)
    assert free.state.position[-1, 0] < -5 and locked.state.position[-1, 0] > 5
    assert np.ptp(free.history.wheel_speed[10]) > 50


def test_locked_differentials_resist_turning_and_vehicles_of_all_layouts_are_one_program():
    flat = ground()
    layouts = [{}, {"locked": "all"}, {"drive": "rear"}, {"drive": "rear", "locked": "rear"}]
    each = [of_layout(**layout) for layout in layouts]
    apart = [drive(flat, at_rest(flat), 2.0, 0.3, params) for params in each]
    yaw_rate = [driven.state.angular_velocity[-1, 2] for driven in apart]
    assert yaw_rate[1] < 0.9 * yaw_rate[0] and yaw_rate[3] < 0.95 * yaw_rate[2]

    several = stack([load("hmmwv").vehicle, *(params.vehicle for params in each[1:])])
    assert several.mass.shape == (4,) and several.select(jnp.int32(1)).locked.shape == (4,)

    def driving(vehicle):
        params = replace(PARAMS, vehicle=vehicle)
        commands = Command(jnp.full(STEPS, 2.0), jnp.full(STEPS, 0.3))
        return rollout(SIMULATOR, params, flat, at_rest(flat), commands)

    together = jax.jit(jax.vmap(driving))(several)
    expected = np.stack([driven.state.vector for driven in apart])
    np.testing.assert_allclose(together.vector, expected, atol=1e-3)


def test_turning_and_moving_the_world_turns_and_moves_the_drive():
    centre = np.array([100.0, -40.0])
    soil = ground(waves, MUD)
    turned = ground(lambda x, y: waves(y, -x), MUD, centre=tuple(centre))
    one = drive(soil, at_rest(soil, y=1.0, yaw=0.3), 3.0, 0.2).state
    other = drive(
        turned, at_rest(turned, x=centre[0] - 1.0, y=centre[1], yaw=0.3 + np.pi / 2), 3.0, 0.2
    ).state
    x, y = one.position[:, 0], one.position[:, 1]
    np.testing.assert_allclose(other.position[:, :2], centre + np.stack([-y, x], 1), atol=0.02)
    np.testing.assert_allclose(other.position[:, 2], one.position[:, 2], atol=0.01)
    np.testing.assert_allclose(other.rpy[:, :2], one.rpy[:, :2], atol=0.01)
    np.testing.assert_allclose(other.velocity, one.velocity, atol=0.02)


@pytest.mark.parametrize("kind", [CONCRETE, SNOW])
@pytest.mark.parametrize("rise", [0.0, 0.2])
@pytest.mark.parametrize("rpy", [(np.pi - 0.1, 0.1, 0.0), (2.5, 0.0, 0.0), (0.0, 1.5, 0.0)])
def test_a_fall_on_roof_side_or_nose_never_gains_energy(kind, rise, rpy):
    terrain = ground(lambda x, y: rise * x, kind)
    start = at_rest(terrain)
    start = replace(start, position=start.position.at[2].add(4.0), rpy=jnp.asarray(rpy))
    state = drive(terrain, start, speed=2.0, seconds=20).state
    assert np.isfinite(state.vector).all()
    assert np.abs(state.velocity).max() < 12
    # What the springs and the engine give back in 0.3 s; a metre of height is 24 kJ.
    before_edge = np.abs(state.position[:, :2]).max(-1) < 30
    gained = (energy(state)[3:] - energy(state)[:-3])[before_edge[3:]]
    assert gained.max() < 45e3


@pytest.fixture(scope="module")
def final() -> Callable[..., tuple[jax.Array, tuple]]:
    """Final position after 0.8 s and its gradients by state, commands and parameters."""

    def total(state, commands, params, terrain, weight):
        history = SIMULATOR.init(params, terrain, state)
        states = rollout(SIMULATOR, params, terrain, state, commands, history)
        return states.position[-1] @ weight

    def by_soil(state, commands, params, soils, terrain, weight):
        return total(state, commands, params, replace(terrain, soils=soils), weight)

    compiled = jax.jit(jax.value_and_grad(by_soil, argnums=(0, 1, 2, 3)))
    # NumPy arguments have no weak types, which would compile it anew.
    return lambda *arguments: compiled(*jax.tree.map(np.asarray, arguments))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [CONCRETE, SNOW])
@pytest.mark.parametrize("start", ["rest", "rolling", "airborne"])
def test_gradients_are_finite(final, kind, start):
    terrain = ground(kind=kind)
    state = at_rest(terrain)
    if start == "rolling":
        state = replace(state, velocity=jnp.array([2.0, 0, 0]))
    if start == "airborne":
        state = replace(state, position=state.position + jnp.array([0, 0, 5.0]))
    commands = Command(jnp.full(8, 0.0 if start == "rest" else 2.0), jnp.zeros(8))
    value, gradients = final(state, commands, PARAMS, terrain.soils, terrain, jnp.ones(3))
    assert np.isfinite(value)
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradients):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [CONCRETE, SNOW])
def test_gradients_agree_with_differences(final, kind):
    terrain = ground(lambda x, y: 0.05 * x, kind)
    weight = jnp.array([1.0, 0.7, 0.3])
    start = replace(at_rest(terrain), velocity=jnp.array([2.0, 0.0, 0.0]))
    commands = Command(jnp.full(8, 3.0), jnp.full(8, 0.15))

    def value(start=start, commands=commands, params=PARAMS, soils=terrain.soils):
        return final(start, commands, params, soils, terrain, weight)

    _, (by_state, by_commands, by_params, by_soils) = value()
    snow = terrain.soils
    mass, kphi = PARAMS.vehicle.mass, snow.kphi
    cases = {
        "speed": (
            by_commands.speed.sum(),
            lambda d: value(commands=replace(commands, speed=commands.speed + d)),
            0.05,
        ),
        "steering": (
            by_commands.steering.sum(),
            lambda d: value(commands=replace(commands, steering=commands.steering + d)),
            0.02,
        ),
        "velocity": (
            by_state.velocity[0],
            lambda d: value(replace(start, velocity=start.velocity.at[0].add(d))),
            0.05,
        ),
        "yaw": (
            by_state.rpy[2],
            lambda d: value(replace(start, rpy=start.rpy.at[2].add(d))),
            0.02,
        ),
        "mass": (
            mass * by_params.vehicle.mass,
            lambda d: value(
                params=replace(PARAMS, vehicle=replace(PARAMS.vehicle, mass=mass * (1 + d)))
            ),
            0.05,
        ),
        "kphi": (
            kphi[0, SNOW] * by_soils.kphi[0, SNOW],
            lambda d: value(soils=replace(snow, kphi=kphi * (1 + d))),
            0.05,
        ),
    }
    for name, (gradient, moved, step) in cases.items():
        difference = float(moved(step)[0] - moved(-step)[0]) / (2 * step)
        assert float(gradient) == pytest.approx(difference, rel=0.1, abs=3e-3), name


@pytest.mark.integration
def test_derivatives_along_a_direction_agree_with_differences():
    """Forward mode, which compiles fast; the full gradients are tested with `-m slow`."""
    terrain = {kind: ground(lambda x, y: 0.05 * x, kind) for kind in (CONCRETE, SNOW)}
    start = replace(at_rest(terrain[SNOW]), velocity=jnp.array([2.0, 0.0, 0.0]))

    def final(state, speed, steering, mass, kphi, terrain):
        params = replace(PARAMS, vehicle=replace(PARAMS.vehicle, mass=mass * PARAMS.vehicle.mass))
        terrain = replace(terrain, soils=replace(terrain.soils, kphi=kphi * terrain.soils.kphi))
        history = SIMULATOR.init(params, terrain, state)
        commands = Command(jnp.full(8, speed), jnp.full(8, steering))
        states = rollout(SIMULATOR, params, terrain, state, commands, history)
        return states.position[-1] @ jnp.array([1.0, 0.7, 0.3])

    @jax.jit
    def along(arguments, direction, terrain):
        return jax.jvp(lambda *arguments: final(*arguments, terrain), arguments, direction)

    at = (start, *map(jnp.float32, (3.0, 0.15, 1.0, 1.0)))
    still = jax.tree.map(jnp.zeros_like, at)
    forward = replace(still[0], velocity=jnp.array([1.0, 0.0, 0.0]))
    turn = replace(still[0], rpy=jnp.array([0.0, 0.0, 1.0]))
    one = jnp.float32(1)
    directions = {
        "velocity": ((forward, *still[1:]), 0.05),
        "yaw": ((turn, *still[1:]), 0.02),
        "speed": ((*still[:1], one, *still[2:]), 0.05),
        "steering": ((*still[:2], one, *still[3:]), 0.02),
        "mass": ((*still[:3], one, *still[4:]), 0.05),
        "kphi": ((*still[:4], one), 0.05),
    }
    for kind, land in terrain.items():
        for name, (direction, step) in directions.items():
            _, found = along(at, direction, land)
            ahead, behind = (
                along(jax.tree.map(lambda a, d, s=s: a + s * d, at, direction), still, land)[0]
                for s in (step, -step)
            )
            difference = float(ahead - behind) / (2 * step)
            assert float(found) == pytest.approx(difference, rel=0.1, abs=3e-3), (kind, name)


def test_a_batch_is_a_loop_and_commands_do_not_retrace():
    terrain = ground(waves, SAND)
    traces = 0

    def predict(state, commands):
        nonlocal traces
        traces += 1
        history = SIMULATOR.init(PARAMS, terrain, state)
        return rollout(SIMULATOR, PARAMS, terrain, state, commands, history)

    starts = [at_rest(terrain, x, y, yaw) for x, y, yaw in ((0, 0, 0), (5, 3, 2), (-4, 6, -1))]
    commands = Command(jnp.array([1.0, 3.0, 0.0]), jnp.array([0.3, -0.1, 0.0]))
    commands = jax.tree.map(lambda c: jnp.tile(c[:, None], STEPS), commands)
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)
    batched = jax.jit(jax.vmap(predict))
    together = batched(batch, commands)
    batched(batch, jax.tree.map(lambda c: 0.5 * c, commands))
    assert traces == 1
    for i, start in enumerate(starts):
        alone = drive(terrain, start, commands.speed[i, 0], commands.steering[i, 0])
        np.testing.assert_allclose(together.position[i], alone.state.position, atol=0.01)


@pytest.mark.integration
def test_few_substeps_are_enough():
    terrain = ground(lambda x, y: 0.3 * waves(x, y), MUD)
    state = at_rest(terrain)
    fine = Simulator(substeps=20)
    commands = Command(jnp.full(16, 3.0), jnp.full(16, 0.2))
    reference = rollout(fine, PARAMS, terrain, state, commands).position
    coarse = drive(terrain, state, 3.0, 0.2).state.position[:16]
    np.testing.assert_allclose(coarse, reference, atol=0.08)
