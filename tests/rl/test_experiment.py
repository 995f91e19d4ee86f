"""What is driven, where: another vehicle brings its shape, and its ground."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax import config, machine
from vertiwm_jax.config import ConfigError
from vertiwm_jax.env import suites
from vertiwm_jax.env.suites import GroundConfig
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.rl import experiment
from vertiwm_jax.rl.experiment import PPOTraining, TaskConfig
from vertiwm_jax.terrain.classes import STANDARD

GROUND = GroundConfig(suites=("easy",), suite_worlds=1, pairs=2)


@pytest.mark.integration
def test_a_rover_is_tested_on_soil_of_its_scale():
    known, rover = (TaskConfig(vehicle=name, ground=GROUND) for name in ("hmmwv", "rover"))
    ground, small = experiment.held_out(known), experiment.held_out(rover)
    np.testing.assert_array_equal(small.elevation, ground.elevation)
    sand = STANDARD.names.index("sand")
    np.testing.assert_allclose(small.soils.cohesion[0, sand], 10 * ground.soils.cohesion[0, sand])
    pool = suites.test_tasks(rover.ground, small)
    _, task = experiment.environment(rover, "builtin", small, pool)
    assert np.isfinite(task.starts.vehicle.vector).all()
    for found in (task.dynamics.vehicle, task.vehicle):
        jax.tree.map(np.testing.assert_array_equal, found, vehicle.load("rover").vehicle)


@pytest.mark.parametrize(
    ("asked", "faster", "found"),
    [
        ("auto", True, "bfloat16"),
        ("auto", False, "float32"),
        ("bfloat16", False, "bfloat16"),
        ("float32", True, "float32"),
    ],
)
def test_models_multiply_what_is_asked_or_faster(asked, faster, found, monkeypatch):
    monkeypatch.setattr(machine, "multiplies_bfloat16", lambda: faster)
    chosen = TaskConfig(compute_dtype=asked)
    assert chosen.fixed_dtype == found
    _, params = experiment.dynamics(chosen, "nesam")
    half = any(leaf.dtype == jnp.bfloat16 for leaf in jax.tree.leaves(params))
    assert half == (found == "bfloat16")


@pytest.mark.parametrize("weights", ["any_vehicle", "own/model"])
def test_a_run_goes_on_from_other_folders(weights, monkeypatch):
    class Loading(Exception):
        pass

    def load(config, model):
        raise Loading(config.weights)

    monkeypatch.setattr(experiment, "dynamics", load)
    with pytest.raises(Loading) as found:
        experiment.run(PPOTraining(weights=Path(weights)))
    # A model that comes with the package may lie elsewhere then.
    own = Path(weights).absolute()
    assert found.value.args == (Path(weights) if weights == "any_vehicle" else own,)


def test_a_vehicle_that_is_none_is_named(tmp_path):
    (tmp_path / "task.yaml").write_text("vehicle: rovr")
    with pytest.raises(ConfigError, match=r"task\.yaml: .*did you mean 'rover'"):
        config.load(TaskConfig, tmp_path / "task.yaml")


def test_a_skid_steered_vehicle_is_not_told_to_drive_faster_than_it_can_turn():
    TaskConfig(vehicle="husky", navigation=NavigationConfig(speed_range=(0.0, 1.3)))
    with pytest.raises(ValueError, match=r"speed_range: expected at most 1\.33 m/s at full size"):
        TaskConfig(vehicle="husky")
    TaskConfig(vehicle="warthog")  # It is faster than the task asks.


def test_a_policy_without_arcs_cannot_correct_a_controller_that_looks_along_them():
    blind = NavigationConfig(arcs=False, embeddings=True)
    with pytest.raises(ConfigError, match="base: expected straight to goal or none, as navigation"):
        PPOTraining(navigation=blind)
    assert PPOTraining(navigation=blind, base="none").controller is None
