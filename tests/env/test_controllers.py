import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import GRASS

from vertiwm_jax.env import route
from vertiwm_jax.env.controllers import LookAhead
from vertiwm_jax.env.observation import ObservationSpec, observe
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain.map import TerrainMap

CONFIG = NavigationConfig()
POLICY = LookAhead(CONFIG)


@jax.jit
def command(terrain, goal):
    """Speed and steering of a vehicle at (0, 0) that looks east."""
    at_rest = VehicleState(jnp.array([0.0, 0.0, 0.47]), *jnp.zeros((3, 3)))
    routes = route.straight(CONFIG.route, terrain, goal[None, :2])
    return load_vehicle().command(
        POLICY(
            observe(
                ObservationSpec(),
                terrain,
                load_vehicle(),
                at_rest,
                goal,
                routes,
                jnp.zeros(2),
                jnp.zeros(2),
            )
        ),
        CONFIG.speed_range,
    )


def ground(height):
    x = np.arange(-64.0, 65.0)
    elevation = height(*np.meshgrid(x, -x)) + np.zeros((129, 129))
    return TerrainMap.from_array(elevation, np.full((16, 16), GRASS))


FLAT = ground(lambda x, y: 0 * x)
AHEAD = jnp.array([40.0, 0.0, 0.0])


@pytest.mark.parametrize("bearing", [0.0, 0.2, -0.2, 1.0, -1.0, 3.0, -3.0])
def test_on_flat_ground_it_steers_to_the_goal(bearing):
    goal = 40 * jnp.array([jnp.cos(bearing), jnp.sin(bearing), 0.0])
    chosen = command(FLAT, goal)
    assert float(chosen.speed) == pytest.approx(POLICY.speed, rel=1e-5)
    # The arc to the goal has a radius of 40 m / (2 sin bearing); behind, either side is far.
    aimed = np.arctan(load_vehicle().wheelbase * np.sin(abs(bearing)) / 20)
    if abs(bearing) < 2:
        assert abs(float(chosen.steering)) == pytest.approx(aimed, abs=0.16)
    else:
        assert abs(float(chosen.steering)) > 0.05
    assert np.sign(np.round(chosen.steering, 4)) == np.sign(bearing)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(
    "height",
    [
        pytest.param(lambda x, y: np.where(y > 1, y - 1, 0) * 0.8, id="bank"),
        pytest.param(
            lambda x, y: np.where(y > 1, np.sin(1.5 * x) * np.sin(1.5 * y), 0), id="rough"
        ),
    ],
)
def test_it_steers_away_from_rough_ground(side, height):
    terrain = ground(lambda x, y: height(x, side * y))
    steering = float(command(terrain, AHEAD).steering)
    assert -side * steering > 0.05
    mirrored = ground(lambda x, y: height(x, -side * y))
    assert float(command(mirrored, AHEAD).steering) == pytest.approx(-steering, abs=1e-3)


@pytest.mark.parametrize(
    ("waiting", "backs_up"),
    [((0.0, 0.0), False), ((0.9, 0.0), False), ((1.0, 0.0), True), ((9.0, 0.0), True)]
    + [((0.0, 0.1), True), ((3.0, 1.4), True), ((0.0, 1.5), False), ((9.0, 1.5), False)],
)
def test_where_it_stalls_it_backs_up_for_a_run_up(waiting, backs_up):
    at_rest = VehicleState(jnp.array([0.0, 0.0, 0.47]), *jnp.zeros((3, 3)))
    routes = route.straight(CONFIG.route, FLAT, AHEAD[None, :2])
    given = load_vehicle(), at_rest, AHEAD, routes, jnp.zeros(2), jnp.array(waiting)
    seen = observe(ObservationSpec(), FLAT, *given)
    config = NavigationConfig(speed_range=(-3.0, 5.0))
    chosen = load_vehicle().command(LookAhead(config)(seen), config.speed_range)
    assert float(chosen.speed) == pytest.approx(-3.0 if backs_up else POLICY.speed, rel=1e-5)
    assert not backs_up or float(chosen.steering) == 0
    forwards = load_vehicle().command(POLICY(seen), CONFIG.speed_range)
    assert float(forwards.speed) == pytest.approx(POLICY.speed, rel=1e-5)
