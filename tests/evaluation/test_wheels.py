import shutil
from dataclasses import replace
from pathlib import Path

import chex
import jax
import numpy as np
import pytest

from vertiwm_jax.evaluation import error_sources, prediction
from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.dataset import WheelSignals
from vertiwm_jax.mechanics.kinematic import ConstantVelocity
from vertiwm_jax.models.config import ModelConfig, with_soil
from vertiwm_jax.models.registry import load_model
from vertiwm_jax.state import VehicleState
from vertiwm_jax.world_model.alone import Alone

OPEN = Path(__file__).parents[2] / "data" / "open"


@pytest.fixture(scope="module")
def test(tmp_path_factory):
    """Windows on soil of one world, with all that is recorded of wheels."""
    folder = tmp_path_factory.mktemp("drives")
    for kind in ("deformable", "maps"):
        (folder / kind).mkdir()
        shutil.copy(OPEN / kind / "deformable_001.npz", folder / kind)
    drives, terrain = dataset.load_drives(folder / "deformable", "test")
    found = TestWindows.of(drives, terrain, context=8, horizon=4, stride=40)
    assert np.all(np.asarray(found.windows.ground) == 1)
    return found


def compared(test, model, params):
    return error_sources.wheels(prediction.predict(model, params, test).read.wheels, test)


@pytest.fixture(scope="module")
def simulated(test):
    return compared(test, *load_model("builtin"))


@pytest.mark.integration
def test_wheels_of_the_simulator_go_with_those_recorded(test, simulated):
    sinkage, _, force = simulated
    quantities = [row["wheels"] for row in simulated]
    assert quantities == ["sinkage, mm", "speed, rad/s", "force, kN"]
    assert all(row["ground"] == "deformable" for row in simulated)
    depth = 1000 * np.maximum(test.windows.wheels.wheel_sinkage[:, -1], 0)
    assert sinkage["recorded mean"] == pytest.approx(depth.mean(), rel=1e-4)
    assert all(row["mean error"] < 0.6 * row["recorded mean"] for row in simulated)
    assert all(row["correlation"] > 0.7 for row in simulated)
    assert 4 < force["recorded mean"] < 9  # A quarter of the vehicle's weight, about.


@pytest.mark.integration
def test_every_model_with_physics_tells_of_its_wheels_and_others_do_not(test, simulated):
    config = ModelConfig()
    params = with_soil(config.init_params(jax.random.key(0), load_model("builtin")[1]), None)
    # Untrained, NeSAM is physics as it is.
    found = compared(test, Alone(config.nesam), params)
    assert len(found) == 3
    for ours, theirs in zip(found, simulated, strict=True):
        assert ours["mean error"] == pytest.approx(theirs["mean error"], rel=1e-3)
    terrain = test.terrain.select(0)
    state = VehicleState.from_vector(test.windows.state[0, 0])
    fused = prediction.modeled_wheels(config.verti_wm.init(params, terrain, state))
    assert fused is not None
    chex.assert_trees_all_equal(
        fused, prediction.modeled_wheels(Alone(config.nesam).init(params, terrain, state))
    )
    assert compared(test, ConstantVelocity(), None) == []


@pytest.mark.integration
def test_what_was_not_recorded_is_not_compared(test, simulated):
    speed = test.windows.wheels.wheel_omega
    some = replace(test, windows=test.windows.replace(wheels=WheelSignals(wheel_omega=speed)))
    assert compared(some, *load_model("builtin")) == [simulated[1]]
    none = replace(test, windows=test.windows.replace(wheels=WheelSignals()))
    assert compared(none, *load_model("builtin")) == []
