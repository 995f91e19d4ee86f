"""Wheels that come back to their own ruts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax import dynamics
from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.state import Command
from vertiwm_jax.terrain.map import TerrainMap

VEHICLE = load_vehicle()
PARAMS = chrono_like(VEHICLE)
FORTH, BACK = 50, 80


def level(kind: str) -> TerrainMap:
    return TerrainMap.from_array(np.zeros((65, 65), np.float32), kind)


@jax.jit(static_argnames="simulator")
def there_and_back(simulator, terrain, steering):
    """States and histories `[T, ...]` of 5 s at 2 m/s, and then backwards."""
    speed = jnp.where(jnp.arange(FORTH + BACK) < FORTH, 2.0, -2.0)
    state = place(terrain, jnp.zeros(2), jnp.float32(0), vehicle=VEHICLE)
    begun = state, simulator.init(PARAMS, terrain, state)

    def advance(carry, command):
        state, history = dynamics.step(simulator, PARAMS, terrain, carry[1], carry[0], command)
        kept = history.replace(ruts=None)
        return (state, history), (state, kept)

    commands = Command(speed, steering * jnp.ones(FORTH + BACK))
    return jax.lax.scan(advance, begun, commands)


@pytest.mark.integration
def test_the_way_back_is_in_the_ruts_of_the_way_there():
    (_, last), (_, histories) = there_and_back(Simulator(ruts=True), level("mud"), 0.0)
    forth, back = slice(30, FORTH), slice(FORTH + 20, FORTH + 35)
    sunk = np.asarray(histories.sinkage)
    # On the way there the front wheels make the rut, in which the rear ones sink a little more.
    front, rear = sunk[forth, :2].mean(), sunk[forth, 2:].mean()
    assert rear > front > 0.04
    # On the way back all sink a little deeper than the rut.
    assert np.all(sunk[back].mean(axis=0) > rear - 2e-3)
    assert sunk[back].mean() < 1.3 * rear
    assert float(last.ruts.depth.max()) == pytest.approx(sunk.max(), abs=2e-3)
    # Without memory the wheels that lead find untouched soil.
    _, (_, without) = there_and_back(Simulator(), level("mud"), 0.0)
    assert np.asarray(without.sinkage)[back, :2].mean() < 0.85 * sunk[back, :2].mean()


def test_the_first_pass_is_what_it_is_without_memory():
    _, (kept, _) = there_and_back(Simulator(ruts=True), level("mud"), 0.1)
    _, (free, _) = there_and_back(Simulator(), level("mud"), 0.1)
    gone = np.linalg.norm((kept.position - free.position)[:FORTH], axis=-1)
    assert gone.max() < 0.05


def test_rigid_ground_has_no_ruts():
    (_, last), (states, _) = there_and_back(Simulator(ruts=True), level("concrete"), 0.1)
    _, (free, _) = there_and_back(Simulator(), level("concrete"), 0.1)
    assert float(last.ruts.depth.max()) == 0
    np.testing.assert_allclose(states.vector, free.vector, atol=1e-4)


def test_the_rut_is_as_wide_as_the_wheels_and_lies_below_them():
    (_, last), (states, _) = there_and_back(Simulator(ruts=True), level("mud"), 0.0)
    x = float(states.position[FORTH, 0])
    across = jnp.arange(-2, 2, 0.05)
    depth = last.ruts.at(jnp.full_like(across, x - 2.0), across)
    tracks = np.abs(np.asarray(VEHICLE.wheel_position)[:2, 1])
    width = float(np.max(VEHICLE.wheel_width))
    deep = np.asarray(depth) > 0.02
    side = np.abs(np.asarray(across))
    assert deep[np.abs(side - tracks[0]) < width / 2 - 0.02].all()
    assert not deep[np.abs(side - tracks[0]) > width / 2 + 0.11].any()
