"""Whose physics is fitted; what is fitted, and in which order, is tested with the command."""

from dataclasses import replace
from pathlib import Path

import chex
import pytest
from learning import recordings

from vertiwm_jax.learning import calibration, pipeline, stages
from vertiwm_jax.learning.pipeline import PipelineConfig
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.models import files
from vertiwm_jax.models.config import ModelConfig
from vertiwm_jax.runs import Run

NESAM = ModelConfig(parts=("nesam",))


def test_a_fit_that_goes_on_keeps_its_vehicle_unless_told(tmp_path, monkeypatch):
    told = []

    def nothing_learned(run, name, inputs, params, *_):
        told.append(str(inputs))
        return params

    monkeypatch.setattr(stages, "fit", nothing_learned)
    recordings.write(tmp_path)
    start, run = files.load(files.PRETRAINED)[1], Run(tmp_path, None)
    for name, driven in ((None, load_vehicle()), ("rover", vehicle.load("rover").vehicle)):
        config = PipelineConfig(model=NESAM, vehicle=name, data=(tmp_path,))
        fitted = pipeline.fit(config, run, start)
        chex.assert_trees_all_equal(fitted.vehicle, driven)
        chex.assert_trees_all_equal(fitted.nesam.network, start.nesam.network)
    # A stage of one is not taken over for the other.
    assert told[0] != told[1]


@pytest.mark.parametrize(
    ("vehicles", "name", "expected"),
    [("one", None, None), ("any", None, 2493.6), ("any", "rover", None)],
)
def test_a_model_of_any_vehicle_learns_by_the_vehicles_of_the_drives(
    tmp_path, monkeypatch, vehicles, name, expected
):
    """Unless one is given; files that describe none are of the one that it goes on from."""
    learned = []

    def nothing_learned(run, stage, inputs, params, data, *_):
        learned.append(data())
        return params

    monkeypatch.setattr(stages, "fit", nothing_learned)
    recordings.write(tmp_path)
    config = PipelineConfig(model=replace(NESAM, vehicles=vehicles), vehicle=name, data=(tmp_path,))
    pipeline.fit(config, Run(tmp_path, None), files.load(files.PRETRAINED)[1])
    (data,) = learned
    for found in (data.vehicles, data.validation_vehicles):
        assert (found is None) == (expected is None)
        if found is not None:
            assert found.mass.tolist() == pytest.approx([expected])


def test_drives_are_of_the_kind_that_their_folder_is_named_after(tmp_path, monkeypatch):
    """Whether that folder is given or the one above; those elsewhere are of no kind."""
    rigid, soft, other = (tmp_path / name for name in ("rigid", "deformable", "mine"))
    for folder in (rigid, soft, other):
        folder.mkdir()
        (folder / "drives.npz").touch()
    for given in ((tmp_path, other), (rigid, soft, other)):
        config = PipelineConfig(data=given)
        assert pipeline.folders(config, ["rigid"]) == [rigid, other]
        assert set(pipeline.folders(config, pipeline.KINDS)) == {rigid, soft, other}
    monkeypatch.chdir(rigid)
    here = PipelineConfig(data=(Path(),))
    assert pipeline.folders(here, ["rigid"]) == [Path()]
    with pytest.raises(DataError, match="drives on mixed ground, or folders of them named so"):
        pipeline.folders(here, ["mixed"])


def test_a_vehicle_that_is_none_is_named():
    with pytest.raises(ValueError, match="did you mean 'rover'"):
        PipelineConfig(vehicle="rovr")


@pytest.mark.integration
def test_stages_from_nothing_are_of_their_vehicle(tmp_path, monkeypatch):
    """By the numbers of the vehicle, whose file may have changed."""
    told = {}

    def nothing_learned(run, name, inputs, params, *_):
        told[name] = str(inputs)
        return params

    monkeypatch.setattr(stages, "fit", nothing_learned)
    monkeypatch.setattr(calibration, "nesam_constants", lambda nesam, params, *_: params)
    recordings.write(tmp_path)
    stage = {}
    for name in (None, "rover"):
        config = PipelineConfig(model=NESAM, vehicle=name, data=(tmp_path,))
        pipeline.fit(config, Run(tmp_path, None))
        stage[name] = dict(told)
    assert "mass=3.5" in stage["rover"]["nesam_single_steps"]
    assert stage[None]["nesam_single_steps"] != stage["rover"]["nesam_single_steps"]
    # What the ground looks like is the same to all of them.
    assert stage[None]["nesam_autoencoders"] == stage["rover"]["nesam_autoencoders"]
