import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import GRASS, SNOW, hills

from vertiwm_jax.env import observation, route
from vertiwm_jax.env.route import RouteConfig
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.networks.policy import ObservationLayout
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain import obstacles, query
from vertiwm_jax.terrain.map import TerrainMap

HMMWV = load_vehicle()
ROUTE, SPEC = RouteConfig(), observation.ObservationSpec()
POSES = jax.tree.map(np.asarray, observation.poses_ahead(HMMWV))
OBSTACLE = np.array([[9.0, 3.0, 4.0, 6.0, 2.0]], np.float32)
CLASSES = slice(observation.GROUND.stop, None)


@jax.jit
def observe(terrain, vehicle, goal, action):
    """What is seen where the way to the goal is straight."""
    routes = route.straight(ROUTE, terrain, goal[None, :2])
    waiting = jnp.array([1.5, 0.5])
    return observation.observe(SPEC, terrain, HMMWV, vehicle, goal, routes, action, waiting)


def vehicle(x, y, yaw):
    return VehicleState(
        position=jnp.array([x, y, 2.5]),
        rpy=jnp.array([0.1, -0.2, yaw]),
        velocity=jnp.array([3.0, 0.1, -0.2]),
        angular_velocity=jnp.array([0.1, 0.2, 0.3]),
    )


def world(origin=None):
    semantic = np.full((16, 16), GRASS)
    semantic[7, 8] = SNOW
    relief = hills() + np.linspace(0, 3, 129, dtype=np.float32)
    return TerrainMap.from_array(relief, semantic, obstacles=OBSTACLE, origin=origin)


def test_layout_and_units():
    goal, action = jnp.array([20.0, 1.0, 2.5]), jnp.array([0.5, -0.25])
    seen = np.asarray(observe(world(), vehicle(0.0, 1.0, 0.0), goal, action))
    assert seen.shape == (observation.OBSERVATION_SIZE,) and seen.dtype == np.float32
    motion = [0.1 / 0.5, -0.2 / 0.5, 3 / 5, 0.1 / 5, -0.2 / 5, 0.1, 0.2, 0.3]
    np.testing.assert_allclose(seen[:8], motion, rtol=1e-6)
    np.testing.assert_allclose(seen[observation.GOAL], [0.4, 1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(seen[11:13], action)
    np.testing.assert_allclose(seen[observation.WAITING], [0.3, 0.1], rtol=1e-6)

    layout = observation.ObservationSpec().parts
    assert observation.ObservationSpec().size == len(seen)
    places = [np.arange(len(seen))[part.where] for part in layout.values()]
    assert sorted(np.concatenate(places)) == list(range(len(seen)))
    named = {name: (seen[part.where] * part.scale).tolist() for name, part in layout.items()}
    assert named["roll"] == pytest.approx([0.1]) and named["pitch"] == pytest.approx([-0.2])
    assert named["velocity"] == pytest.approx([3.0, 0.1, -0.2])
    assert named["angular velocity"] == pytest.approx([0.1, 0.2, 0.3])
    assert named["goal distance"] == pytest.approx([20.0])
    assert named["goal bearing"] == pytest.approx([1.0, 0.0], abs=1e-6)
    assert named["last action"] == pytest.approx([0.5, -0.25])
    assert named["stalled"] == pytest.approx([1.5]) and named["backing"] == pytest.approx([0.5])
    ahead = observation.arcs_ahead(jnp.asarray(seen))
    for name, found in zip(
        ("height", "crown", "rise", "bank", "twist", "route"), ahead, strict=True
    ):
        np.testing.assert_array_equal(seen[layout[name].where][1:], found.ravel())
    classes = seen[CLASSES].reshape(-1, 2)
    np.testing.assert_array_equal(seen[layout["friction"].where], classes[:, 0])
    np.testing.assert_array_equal(seen[layout["sinkage"].where], classes[:, 1])


def test_poses_lie_on_the_arcs_of_a_bicycle():
    xy, heading = POSES
    assert xy[0].tolist() == [0, 0] and heading[0] == 0
    shape = observation.ARC_STEERING.size, observation.ARC_STATIONS.size
    x, y = xy[1:].reshape(*shape, 2).transpose(2, 0, 1)
    heading = heading[1:].reshape(shape)
    driven = HMMWV.wheelbase * observation.ARC_STATIONS
    np.testing.assert_allclose(x[4], driven, rtol=1e-6)
    np.testing.assert_allclose([y[4], heading[4]], 0, atol=1e-12)
    # The sharpest one, to the left, goes round (0, radius).
    radius = HMMWV.wheelbase / np.tan(HMMWV.steering_limit)
    np.testing.assert_allclose(np.hypot(x[-1], y[-1] - radius), radius, rtol=1e-6)
    np.testing.assert_allclose(np.arctan2(x[-1], radius - y[-1]), driven / radius, rtol=1e-6)
    np.testing.assert_allclose(heading[-1], driven / radius, rtol=1e-6)
    np.testing.assert_allclose([x[0], -y[0], -heading[0]], [x[-1], y[-1], heading[-1]])


def on_ground(height):
    """What the ground does to a vehicle at (0, 0) that looks 0.4 rad to the north of east."""
    x = np.arange(-64.0, 65.0)
    terrain = TerrainMap.from_array(height(*np.meshgrid(x, -x)), np.full((16, 16), GRASS))
    seen = observe(terrain, vehicle(0.0, 0.0, 0.4), jnp.ones(3), jnp.zeros(2))
    return np.asarray(seen)[observation.GROUND].reshape(6, -1)


def test_a_plane_rises_and_banks_and_nothing_else():
    height, crown, rise, bank, twist, _ = on_ground(lambda x, y: 0.2 * x + 0.1 * y)
    place, heading = POSES
    direction = heading + 0.4
    np.testing.assert_allclose(
        rise, (0.2 * np.cos(direction) + 0.1 * np.sin(direction)) / 0.4, atol=1e-3
    )
    np.testing.assert_allclose(
        bank, (0.1 * np.cos(direction) - 0.2 * np.sin(direction)) / 0.4, atol=1e-3
    )
    np.testing.assert_allclose([crown, twist], 0, atol=2e-3)
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    expected = (place @ turn.T @ [0.2, 0.1] - 2.5) / 2
    np.testing.assert_allclose(height, expected, atol=1e-3)


def test_a_saddle_twists_and_a_hump_crowns():
    # At the origin, z = u v / 40 along and across the vehicle: four equal heights, signs in turn.
    cos, sin = np.cos(0.4), np.sin(0.4)
    saddle = on_ground(lambda x, y: (cos * x + sin * y) * (cos * y - sin * x) / 40)[:, 0]
    lifted = HMMWV.wheelbase * HMMWV.track / 4 / 40
    np.testing.assert_allclose(saddle[4], 4 * lifted / (2 * HMMWV.track * 0.2), atol=0.02)
    np.testing.assert_allclose(saddle[1:4], 0, atol=0.02)
    hump = on_ground(lambda x, y: -(x**2 + y**2) / 20)[:, 0]
    corner = (HMMWV.wheelbase**2 + HMMWV.track**2) / 4
    np.testing.assert_allclose(hump[1], corner / 20 / 0.2, atol=0.1)  # bilinear between metres
    np.testing.assert_allclose(hump[2:5], 0, atol=0.05)


def test_without_arcs_only_the_vehicle_and_its_goal_are_seen():
    spec, goal, action = observation.ObservationSpec(arcs=False), jnp.ones(3), jnp.array([0.1, 0.2])
    here, given = vehicle(2.0, 1.0, 0.4), world()
    routes = route.straight(ROUTE, given, goal[None, :2])
    seen = observation.observe(
        spec, given, HMMWV, here, goal, routes, action, jnp.array([1.5, 0.5])
    )
    assert spec.layout == ObservationLayout() and spec.size == len(seen) == 15
    np.testing.assert_allclose(seen, observe(given, here, goal, action)[:15], atol=1e-6)


def test_the_goal_is_in_the_frame_of_the_vehicle():
    left = jnp.array([0.0, 30.0, 2.5])
    seen = observe(world(), vehicle(0.0, 0.0, jnp.pi / 6), left, jnp.zeros(2))
    expected = [0.6, np.cos(np.pi / 3), np.sin(np.pi / 3)]
    np.testing.assert_allclose(seen[observation.GOAL], expected, atol=1e-6)


def test_moving_the_world_changes_nothing():
    goal, action = jnp.array([20.0, -7.0, 2.0]), jnp.zeros(2)
    here = observe(world(), vehicle(2.0, 1.0, 0.4), goal, action)
    shift = jnp.array([32.0, -48.0, 0.0])
    moved_world = world(origin=(-64.0 + 32.0, 64.0 - 48.0))
    moved_world = moved_world.replace(
        obstacles=moved_world.obstacles + jnp.append(shift[:2], jnp.zeros(3))
    )
    moved = vehicle(2.0 + 32.0, 1.0 - 48.0, 0.4)
    np.testing.assert_allclose(observe(moved_world, moved, goal + shift, action), here, atol=2e-5)


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_turning_the_world_changes_nothing(quarter_turns):
    still = world()
    goal, action = jnp.array([20.0, -7.0, 2.0]), jnp.zeros(2)
    here = observe(still, vehicle(2.0, 1.0, 0.4), goal, action)

    def turn(x, y):
        for _ in range(quarter_turns):
            x, y = -y, x
        return x, y

    x, y, wide, tall, height = OBSTACLE[0]
    if quarter_turns % 2:
        wide, tall = tall, wide
    # Row 0 is north, so that rot90 turns the raster to the left as `turn` does.
    turned = TerrainMap.from_array(
        np.rot90(still.elevation[0], quarter_turns),
        np.rot90(still.semantic[0], quarter_turns),
        obstacles=np.array([[*turn(x, y), wide, tall, height]]),
    )
    there = vehicle(*turn(2.0, 1.0), 0.4 + quarter_turns * jnp.pi / 2)
    turned_goal = jnp.array([*turn(20.0, -7.0), 2.0])
    np.testing.assert_allclose(observe(turned, there, turned_goal, action), here, atol=2e-4)


def test_obstacles_soil_and_the_edge_are_seen():
    terrain = world()
    goal = jnp.array([0.0, 30.0, 0.0])
    beside = vehicle(4.0, 3.0, 0.0)
    seen = observe(terrain, beside, goal, jnp.zeros(2))
    bare = observe(
        terrain.replace(obstacles=jnp.zeros_like(terrain.obstacles)),
        beside,
        goal,
        jnp.zeros(2),
    )
    change = np.stack(observation.arcs_ahead(seen)) - np.stack(observation.arcs_ahead(bare))
    wall = np.asarray(observation.arcs_ahead(seen)[1]) == 7.5
    np.testing.assert_array_equal((change != 0).any(axis=0), wall)
    assert not change[[0, 2, 3, 4, 5]].any()
    # A wall where the vehicle, and a margin of 0.3 m, would touch the obstacle.
    place, heading = POSES
    poses = place[1:] + np.array([4.0, 3.0]), jnp.asarray(heading[1:])
    hit = obstacles.collides(terrain, *poses, HMMWV.length + 0.6, HMMWV.width + 0.6)
    np.testing.assert_array_equal(wall.ravel(), hit)
    assert 3 < hit.sum() < len(hit) - 3

    friction, sinkage = np.asarray(seen)[CLASSES].reshape(-1, 2).T
    snow = sinkage > 0
    assert snow.any() and (~snow).any()
    np.testing.assert_allclose(friction[~snow], 0.36, rtol=1e-6)
    assert (friction[snow] == 0).all()

    outward = observe(terrain, vehicle(60.0, 0.0, 0.0), goal, jnp.zeros(2))
    friction = np.asarray(outward)[CLASSES].reshape(-1, 2)[:, 0]
    assert (friction == -1).any() and (friction > 0).any()


def test_softer_soil_sinks_more_and_rigid_ground_not_at_all():
    sinkage = np.asarray(observation.plate_sinkage(world()))
    assert (sinkage[:7] == 0).all() and (sinkage[7:] > 0).all()
    soils = query.soils(world())
    pressure = (soils.kc[SNOW] / 0.25 + soils.kphi[SNOW]) * sinkage[SNOW] ** soils.n[SNOW]
    np.testing.assert_allclose(pressure, 50e3, rtol=1e-4)


def test_gradients_are_finite_at_the_goal():
    state, terrain = vehicle(0.0, 0.0, 0.3), world()

    def total(position):
        moved = state.replace(position=position)
        return observe(terrain, moved, state.position, jnp.zeros(2)).sum()

    assert jnp.isfinite(jax.jit(jax.grad(total))(state.position)).all()


def test_each_arc_is_a_candidate_and_nothing_seen_is_lost():
    seen = jnp.arange(observation.OBSERVATION_SIZE, dtype=jnp.float32)
    arcs, rest = observation.ARCS.split(seen)
    assert arcs.shape == (9, 49) and len(observation.ARCS.actions) == 9
    np.testing.assert_allclose(arcs[:, -1], observation.ARC_STEERING)
    np.testing.assert_allclose([speed for speed, _ in observation.ARCS.actions], 0.0)
    np.testing.assert_allclose(
        [steering for _, steering in observation.ARCS.actions], observation.ARC_STEERING
    )
    entries = np.concatenate([np.ravel(arcs[:, :-1]), rest])
    np.testing.assert_array_equal(np.sort(entries), seen)
    heights = observation.arcs_ahead(seen)[0]
    np.testing.assert_array_equal(arcs[:, :8], heights)


def test_the_edge_of_the_map_is_a_wall():
    terrain = world()
    edge = float(terrain.origin[0] + 128 * terrain.resolution)
    state = vehicle(edge - 5.0, 0.0, 0.0)
    found = observe(terrain, state, jnp.zeros(3), jnp.zeros(2))
    crown = np.ravel(observation.arcs_ahead(found)[1])
    outside = POSES[0][1:, 0] > 5.0
    np.testing.assert_allclose(crown[outside], 7.5, rtol=1e-6)
    assert np.all(crown[~outside] < 2.0) and 0 < outside.sum() < outside.size


def test_arcs_are_those_that_a_vehicle_can_steer():
    sharp = HMMWV.replace(steering_limit=jnp.float32(0.6))
    heading = observation.poses_ahead(sharp)[1][1:].reshape(observation.ARC_STEERING.size, -1)
    # With half of the action, half of the angle: what is commanded is what was looked at.
    command = sharp.command(jnp.array([0.0, 0.5]), (0.0, 6.0))
    driven = HMMWV.wheelbase * observation.ARC_STATIONS
    turned = driven * np.tan(float(command.steering)) / HMMWV.wheelbase
    np.testing.assert_allclose(heading[6], turned, rtol=1e-6)
