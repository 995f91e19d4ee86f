"""Where soil and rigid ground meet under one wheel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.dynamics import rollout
from vertiwm_jax.mechanics.contact import LEAST_YIELD, GroundContact, contacts
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.vector import Axes, Vector

CONCRETE, MUD, SNOW = 1, 7, 9
VEHICLE = load_vehicle()
RADIUS, WIDTH = float(VEHICLE.wheel_radius), float(VEHICLE.wheel_width)
SUNK = 0.1


def halves(left: int, right: int, lengthwise: bool = False) -> TerrainMap:
    """Flat ground of two classes that meet at x = 0, or at y = 0 with `left` at y > 0."""
    classes = np.full((8, 8), left)
    classes[(slice(4, None), slice(None)) if lengthwise else (slice(None), slice(4, None))] = right
    return TerrainMap.from_array(np.zeros((65, 65)), classes, friction=np.full((8, 8), 0.8))


def wheels(
    terrain: TerrainMap, x: float = 0.0, y: float = 0.0, depth: float = SUNK, sinkage: float = SUNK
) -> GroundContact:
    """Contacts of a level vehicle whose front left wheel is over (x, y), `depth` m deep."""
    at = VEHICLE.wheel_position[0]
    position = Vector(*jnp.array([x - at[0], y - at[1], RADIUS - depth], jnp.float32))
    axes = Axes.from_quaternion(jnp.array([1.0, 0, 0, 0]))
    still = jnp.zeros(4)
    return contacts(VEHICLE, terrain, position, axes, still, still, jnp.full(4, sinkage))[0]


def test_on_one_kind_of_ground_the_contact_does_not_depend_on_sinkage():
    for kind in (CONCRETE, MUD):
        one, other = (wheels(halves(kind, kind), sinkage=s) for s in (0.0, 0.2))
        np.testing.assert_allclose(one.depth, SUNK, atol=1e-3)
        np.testing.assert_allclose(one.depth, other.depth, atol=1e-6)
        np.testing.assert_allclose(one.point.x, other.point.x, atol=1e-6)
        assert (one.soft == (kind == MUD)).all()
        assert not one.edge.any()


@pytest.mark.parametrize("side", [1, -1])
def test_a_wheel_in_soil_leans_on_the_edge_of_rigid_ground(side):
    """Ahead of it, or behind, 0.1 m away: it has to be pushed away from there, and up."""
    terrain = halves(MUD, CONCRETE) if side > 0 else halves(CONCRETE, MUD)
    found = wheels(terrain, x=-0.1 * side)
    assert found.edge[0]
    assert not found.soft[0]
    assert found.friction[0] == pytest.approx(0.8)
    assert found.normal.x[0] * side < -0.3
    assert found.normal.z[0] > 0
    assert found.point.x[0] * side > VEHICLE.wheel_position[0, 0] * side + 0.1
    assert np.linalg.norm([c[0] for c in found.normal]) == pytest.approx(1, abs=1e-6)


def test_no_edge_is_felt_from_afar_nor_once_it_is_climbed():
    terrain = halves(MUD, CONCRETE)
    afar = wheels(terrain, x=-RADIUS)
    assert afar.soft[0]
    assert not afar.edge[0]
    climbed = wheels(terrain, x=0.1, depth=0.0)
    assert not climbed.soft[0]
    assert not climbed.edge[0]
    assert climbed.normal.z[0] == pytest.approx(1)


def test_rigid_ground_under_one_rim_carries_the_wheel():
    """Whichever rim, though the other stands over soil; also before it has sunk there."""
    for sinkage in (0.0, SUNK):
        left = wheels(halves(CONCRETE, MUD, lengthwise=True), y=0.02, sinkage=sinkage)
        right = wheels(halves(MUD, CONCRETE, lengthwise=True), y=-0.02, sinkage=sinkage)
        for found, rim in ((left, WIDTH / 2), (right, -WIDTH / 2)):
            assert not found.soft[0]
            assert not found.edge[0]
            assert found.point.y[0] - VEHICLE.wheel_position[0, 1] == pytest.approx(rim, abs=1e-3)
            assert found.depth[0] == pytest.approx(SUNK, abs=1e-3)


def test_what_carries_a_wheel_on_soil_is_soil():
    """Rigid ground higher up on its rim than it has sunk does not count."""
    found = wheels(halves(MUD, CONCRETE), x=-0.2, depth=LEAST_YIELD, sinkage=LEAST_YIELD)
    assert found.soft[0]
    assert found.friction[0] == 0
    assert found.soil.kphi[0] == halves(MUD, MUD).soils.kphi[0, MUD]


def test_driving_out_of_deep_snow_onto_concrete_is_climbing_a_step():
    simulator, params = Simulator(), chrono_like(VEHICLE)
    start = VehicleState(
        jnp.array([-6.0, 0.3, 0.35]), jnp.zeros(3), jnp.array([1.0, 0, 0]), jnp.zeros(3)
    )
    commands = Command(jnp.ones(60), jnp.zeros(60))

    @jax.jit
    def speeds(terrain: TerrainMap) -> jax.Array:
        history = simulator.init(params, terrain, start)
        driven = rollout(simulator, params, terrain, start, commands, history)
        return driven.velocity[10:, 0]

    in_snow, out_of_it = speeds(halves(SNOW, SNOW)), speeds(halves(SNOW, CONCRETE))
    assert out_of_it.min() < 0.6 * in_snow.min()
    assert out_of_it[-1] > in_snow[-1]
    assert out_of_it.max() < 1.3
