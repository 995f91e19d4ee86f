from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from vertiwm_jax.adaptation.soil_filter import SoilFilter
from vertiwm_jax.evaluation import adaptation
from vertiwm_jax.learning.dataset import Drives, WheelSignals
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import GRAVITY, load_vehicle
from vertiwm_jax.mechanics.wheel import Wheel
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import PRESETS, to_unit

MUD = 7
TERRAIN = TerrainMap.from_array(np.full((65, 65), 4.0), np.full((8, 8), MUD))
STEPS = 80


@dataclass(frozen=True)
class Slowed:
    """Firm soil lets through what is commanded, and soft soil less."""

    def init(self, params, terrain, state):
        return ()

    def step(self, params, terrain, history, state, command):
        kind = query.surface(terrain, state.position[:2]).semantic
        soil = query.soil(terrain, kind)
        ahead = 0.1 * command.speed * to_unit(soil)[1]
        return replace(state, position=state.position.at[0].add(ahead)), history


def driven() -> Drives:
    """Two drives by `Slowed` on mud, of which the second ends early."""
    share = float(to_unit(PRESETS["mud"])[1])
    state = np.zeros((2, STEPS + 1, 12), np.float32)
    state[..., 0] = -10 + 0.1 * 2.0 * share * np.arange(STEPS + 1)
    control = np.tile(np.float32([2.0, 0.0]), (2, STEPS, 1))
    kinds = np.full((2, STEPS + 1, 4), MUD, np.uint8)
    length, world = np.array([STEPS, 50], np.int32), np.zeros(2, np.int32)
    return Drives(state, control, length, kinds, world, WheelSignals())


def test_predictions_get_better_as_the_drive_goes_on():
    drives = driven()
    wrong = adaptation.mistaken(TERRAIN, PRESETS["snow"])
    adapted = adaptation.adapt(SoilFilter(memory=1.0), Slowed(), None, wrong, drives)
    # Blocks of eight steps, of which the first has no history; none after the end of a drive.
    np.testing.assert_array_equal(adapted.accepted[0, :, MUD], np.arange(10))
    np.testing.assert_array_equal(adapted.accepted[1, :, MUD], np.minimum(np.arange(10), 5))
    index = adaptation.windows_on_soil(drives, TERRAIN)
    found = adaptation.errors(Slowed(), None, TERRAIN, wrong, adapted, drives, index)
    means = {name: [x.mean for _, x in rows.values()] for name, rows in found.items()}
    shares = [float(to_unit(PRESETS[name])[1]) for name in ("mud", "snow")]
    missed = 1.6 * 2.0 * (shares[0] - shares[1])
    assert [n for n, _ in found["true"].values()] == [5, 1]
    np.testing.assert_allclose(means["true"], 0, atol=1e-5)
    np.testing.assert_allclose(means["wrong"], missed, rtol=1e-3)
    assert means["wrong, adapted"][0] < 0.2 * missed
    assert means["wrong, adapted"][1] < 0.05 * missed
    table = adaptation.format_errors(found).splitlines()
    assert table[2] == "| soils | 0 to 5 s (n = 5) | 5 to 10 s (n = 1) |"
    assert table[5].startswith(f"| wrong | {missed:.3f} (")


def test_wrong_soils_are_those_of_soft_ground_alone():
    wrong = adaptation.mistaken(TERRAIN, PRESETS["snow"])
    soft = np.asarray(TERRAIN.deformable)
    assert (np.asarray(wrong.soils.kphi)[0, soft] == PRESETS["snow"].kphi).all()
    same = np.asarray(wrong.soils.kphi == TERRAIN.soils.kphi)[0]
    assert same[~soft].all()


def test_behaviour_is_that_under_a_quarter_of_the_weight():
    params, soil = chrono_like(load_vehicle()), PRESETS["sand"]
    vehicle = params.vehicle
    sinkage, pull = adaptation.behaviour(params, soil)
    stiff = replace(soil, kc=1.8 * soil.kc, kphi=1.8 * soil.kphi)
    wheel = Wheel(vehicle.wheel_radius, vehicle.wheel_width)

    def forces(z):
        spin = 2.0 / 0.8 / vehicle.wheel_radius
        return params.contact.forces(wheel, stiff, z, 2.0, 0.0, spin)

    load = float(vehicle.mass) * GRAVITY / 4
    expected = brentq(lambda z: float(forces(z).normal) - load, 1e-4, 0.3, xtol=1e-6)
    assert float(sinkage) == pytest.approx(expected, rel=1e-3)
    assert float(pull) == pytest.approx(float(forces(expected).longitudinal), rel=1e-3)


def test_recovery_tells_what_the_soil_does():
    wrong = adaptation.mistaken(TERRAIN, PRESETS["snow"])
    count = np.zeros((2, 3, 10), int)
    count[0, -1, MUD] = 9
    soils = jax.tree.map(lambda x: jnp.broadcast_to(x, (2, 3, *x.shape)), query.soils(TERRAIN))
    adapted = adaptation.Adapted(soils, count, 0 * count, 8)
    (row,) = adaptation.recovery(chrono_like(load_vehicle()), TERRAIN, wrong, adapted)
    assert row["soil"] == "mud" and row["drives"] == "1" and row["measurements, refused"] == "9, 0"
    true, _, before = row["sinkage, mm: true / wrong"].partition(" / ")
    assert float(true) < 0.5 * float(before)
    assert row["sinkage, mm: adapted"] == f"{true} ({true} to {true})"
