from dataclasses import dataclass, replace

import numpy as np
import pytest

from benchmarks import soil_adaptation
from vertiwm_jax.adaptation.soil_filter import SoilFilter
from vertiwm_jax.learning.dataset import Drives, WheelSignals
from vertiwm_jax.learning.schema import DataError
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
    wrong = soil_adaptation.mistaken(TERRAIN, PRESETS["snow"])
    beliefs = soil_adaptation.adapt(SoilFilter(memory=1.0), Slowed(), None, wrong, drives)
    # Blocks of eight steps, of which the first has no history; none after the end of a drive.
    np.testing.assert_array_equal(beliefs.accepted[0, :, MUD], np.arange(10))
    np.testing.assert_array_equal(beliefs.accepted[1, :, MUD], np.minimum(np.arange(10), 5))
    index = soil_adaptation.windows_on_soil(drives, TERRAIN)
    found = soil_adaptation.compare(Slowed(), None, TERRAIN, wrong, drives, index, beliefs)
    parts = soil_adaptation.periods(index)
    means = {name: [x[here].mean() for here in parts.values()] for name, x in found.items()}
    shares = [float(to_unit(PRESETS[name])[1]) for name in ("mud", "snow")]
    missed = 1.6 * 2.0 * (shares[0] - shares[1])
    assert {name: here.sum() for name, here in parts.items()} == {"0 to 5 s": 5, "5 to 10 s": 1}
    np.testing.assert_allclose(means["true"], 0, atol=1e-5)
    np.testing.assert_allclose(means["wrong"], missed, rtol=1e-3)
    assert means["wrong, adapted"][0] < 0.2 * missed
    assert means["wrong, adapted"][1] < 0.05 * missed


def test_wrong_soils_are_those_of_soft_ground_alone():
    wrong = soil_adaptation.mistaken(TERRAIN, PRESETS["snow"])
    soft = np.asarray(TERRAIN.deformable)
    assert (np.asarray(wrong.soils.kphi)[0, soft] == PRESETS["snow"].kphi).all()
    same = np.asarray(wrong.soils.kphi == TERRAIN.soils.kphi)[0]
    assert same[~soft].all()


def test_drives_without_soil_are_refused():
    grass = TerrainMap.from_array(np.full((65, 65), 4.0), np.full((8, 8), 3))
    drives = driven()
    drives = replace(drives, wheel_class=np.full_like(drives.wheel_class, 3))
    with pytest.raises(DataError, match="32 steps on soil alone, found none"):
        soil_adaptation.windows_on_soil(drives, grass)
