"""Drives that cross their own tracks, made by the simulator itself."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import ruts
from vertiwm_jax.dynamics import rollout
from vertiwm_jax.learning.dataset import Drives, WheelSignals
from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle, stack
from vertiwm_jax.state import Command
from vertiwm_jax.terrain.map import TerrainMap

STEPS = 112
VEHICLE = load_vehicle()


@pytest.fixture(scope="module")
def recorded():
    """One drive 4 s ahead and then back, on mud that remembers it; the map; the vehicle."""
    terrain = TerrainMap.from_array(np.zeros((65, 65), np.float32), "mud")
    speed = jnp.where(jnp.arange(STEPS) < 40, 2.0, -2.0)
    control = Command(speed, jnp.zeros(STEPS))
    params = chrono_like(VEHICLE)
    start = place(terrain, jnp.zeros(2), jnp.float32(0), vehicle=VEHICLE)
    found = rollout(Simulator(ruts=True), params, terrain, start, control)
    state = np.concatenate([start.vector[None], found.vector])[None]
    drives = Drives(
        state=state,
        control=np.asarray(control.vector)[None],
        length=np.array([STEPS]),
        wheel_class=np.full((1, STEPS + 1, 4), terrain.class_names.index("mud")),
        world=np.zeros(1, np.int32),
        wheels=WheelSignals(),
    )
    return drives, terrain, stack([VEHICLE])


@pytest.mark.integration
def test_what_comes_back_crosses_its_own_tracks(recorded):
    """From 3 s after they were made: not on the way there, but for most of the way back."""
    found = ruts.crossing(*recorded)[0]
    assert not found[:2].any() and found[4:].all()


@pytest.mark.integration
def test_who_remembers_ruts_predicts_a_drive_in_them(recorded):
    drives, terrain, driven = recorded
    given = tuple(map(jnp.asarray, (drives.state, drives.control, drives.world)))
    params = chrono_like(VEHICLE)
    kept, free = (
        np.asarray(ruts.errors(Simulator(ruts=each), params, terrain, given, driven))[0]
        for each in (True, False)
    )
    assert kept.max() < 1e-3
    assert free[:2].max() < 0.05 and free[4:].max() > 10 * kept.max()
