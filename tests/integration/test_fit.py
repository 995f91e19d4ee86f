"""`python -m vertiwm_jax.fit` from end to end, on settings so small that compiling is its cost."""

import itertools
import shutil
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from doors import door, opened, refusal

from vertiwm_jax import runs
from vertiwm_jax.checkpoints import CheckpointError
from vertiwm_jax.dynamics import rollout
from vertiwm_jax.learning import dataset
from vertiwm_jax.models import files
from vertiwm_jax.models.config import ModelConfig
from vertiwm_jax.models.registry import load_model
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.world_model.fusion import POSITION_AND_YAW

RECORDED = Path(__file__).parents[1] / "data" / "chrono_drives"
STAGES = (
    "nesam_autoencoders", "nesam_soil", "nesam_single_steps", "nesam_rollouts",
    "transformer_autoencoders", "transformer_single_steps", "transformer_rollouts", "gate",
)  # fmt: skip
SHORT = "{updates: 2, updates_per_iteration: 1, warm_up: 0}"
TINY = f"""
windows: {{batch: 2, context: 2, horizon: 3, validation: 2}}
patches: {{batch: 2, validation: 2}}
transformer: {{autoencoders: {SHORT}, single_steps: {SHORT}, rollouts: {SHORT}}}
nesam: {{autoencoders: {SHORT}, single_steps: {SHORT}, rollouts: {SHORT}}}
soil: {SHORT}
gate: {{learns_from: [deformable], rollouts: {SHORT}}}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two collections of 25 drives, which are few drives several times over."""
    folder = tmp_path_factory.mktemp("fit")
    (folder / "tiny.yaml").write_text(TINY)
    for kind in ("rigid", "deformable"):
        (folder / "drives" / kind).mkdir(parents=True)
        with np.load(RECORDED / f"{kind}_001.npz", allow_pickle=False) as file:
            arrays = {name: file[name] for name in file if name != "split"}
        count = len(arrays["length"])
        rows = np.arange(25) % count
        np.savez(
            folder / "drives" / kind / "world.npz",
            **{name: x[rows] if len(x.shape) else x for name, x in arrays.items()},
        )
    shutil.copytree(RECORDED / "maps", folder / "drives" / "maps")
    return folder


@pytest.fixture(scope="module")
def fitted(folder):
    """Runs the door; gives the newest run folder."""
    tiny, drives = folder / "tiny.yaml", folder / "drives"
    return opened(door("fit"), folder, "--config", str(tiny), "--data", str(drives))


@pytest.fixture(scope="module")
def run(fitted):
    return fitted()


def test_every_stage_leaves_its_metrics_and_all_together_a_model(run, folder):
    for stage in STAGES:
        lines = runs.read_metrics(run / stage)
        assert [line["updates"] for line in lines] == [1, 2], stage
        assert all(np.isfinite(line["error"]) for line in lines), stage
    drives, terrain = dataset.load_drives(folder / "drives" / "deformable", "test")
    state = VehicleState.from_vector(jnp.asarray(drives.state[0, 0]))
    commands = Command.from_vector(jnp.asarray(drives.control[0, :3]))
    ground = terrain.select(jnp.int32(0))
    ends = {}
    for name in ("transformer", "nesam", "vertiwm", "builtin"):
        dynamics, params = load_model(name, run / "model")
        history = dynamics.init(params, ground, state)
        states = rollout(dynamics, params, ground, state, commands, history)
        ends[name] = np.asarray(states.position[-1])
        assert np.linalg.norm(ends[name] - drives.state[0, 3, :3]) < 0.3, name
    assert len({tuple(end) for end in ends.values()}) == 4


def test_constants_are_measured_and_only_what_is_named_is_learned(run):
    untrained = ModelConfig().init_params(jax.random.key(0), load_model("builtin")[1])
    params = files.load(run / "model")[1]
    assert np.all(np.asarray(params.nesam.correction_scale) != 1)
    scale = np.asarray(params.gate.scale)
    assert np.all(scale[list(POSITION_AND_YAW)] == 0) and (scale > 0).sum() > 50
    physics = (params.vehicle, params.nesam.contact, params.nesam.stiffening)
    expected = (untrained.vehicle, untrained.nesam.contact, untrained.nesam.stiffening)
    chex.assert_trees_all_equal(physics, expected)
    for specialist in (params.transformer, params.nesam):
        deviation = np.asarray(specialist.normalization.transition_deviation)
        assert np.all(deviation != 1)


def test_stages_that_have_ended_are_not_repeated(run, fitted, capsys):
    before = files.load(run / "model")[1]
    times = {stage: (run / stage / "fitted").stat().st_mtime_ns for stage in STAGES}
    shutil.rmtree(run / "gate")
    shutil.rmtree(run / "model")
    capsys.readouterr()
    assert fitted("--resume", str(run)) == run
    printed = capsys.readouterr().out
    assert "gate" in printed and "single_steps" not in printed
    chex.assert_trees_all_equal(files.load(run / "model")[1], before)
    for stage in STAGES[:-1]:
        assert (run / stage / "fitted").stat().st_mtime_ns == times[stage], stage


@pytest.mark.slow
def test_another_gate_for_the_specialists_of_an_earlier_run(run, fitted, capsys):
    capsys.readouterr()
    other = fitted("--model.coefficients", "scalar", "--reuse", str(run))
    assert other != run
    printed = capsys.readouterr().out
    for stage in STAGES[:-1]:
        assert f"{stage}: from {run}" in printed
    assert "gate: from" not in printed
    config, params = files.load(other / "model")
    assert config.coefficients == "scalar"
    chex.assert_trees_all_equal(params.nesam, files.load(run / "model")[1].nesam)
    assert (other / "learning_curves.png").stat().st_size > 10_000


@pytest.mark.slow
def test_specialists_may_share_the_encoders_of_one(run, fitted):
    shared = fitted("--model.encoders", "shared", "--reuse", str(run))
    assert not (shared / "nesam_autoencoders").exists()
    params, before = (files.load(place / "model")[1] for place in (shared, run))
    assert len(params.encoders) == 1 and len(before.encoders) == 2
    for name in ("elevation", "semantic", "reduce"):
        weights = (getattr(x.encoders[0], name) for x in (params, before))
        chex.assert_trees_all_equal(*weights)
    chex.assert_trees_all_equal(params.transformer, before.transformer)


def test_gates_are_added_to_specialists_that_stay_as_they_are(run, fitted, folder):
    further = fitted(
        *("--start", str(run / "model"), "--model.gates", "2"),
        *("--nesam.rollouts.updates", "0", "--transformer.rollouts.updates", "0"),
    )
    stages = {path.name for path in further.iterdir() if path.is_dir()}
    assert stages == {"gate", "gate_1", "model"}
    (_, before), (config, after) = (files.load(place / "model") for place in (run, further))
    assert config.gates == len(after.gate) == 2
    chex.assert_trees_all_equal(
        (after.nesam, after.transformer, after.gate.scale),
        (before.nesam, before.transformer, before.gate.scale),
    )
    gates = before.gate, *map(after.gate.only, (0, 1))
    for one, other in itertools.combinations(gates, 2):
        pairs = zip(*map(jax.tree.leaves, (one.network, other.network)), strict=True)
        assert any(not np.array_equal(x, y) for x, y in pairs)
    message = refusal(door("fit"), "--config", folder / "tiny.yaml", "--start", further / "model")
    assert "gates=1" in message and "gates=2" in message


@pytest.mark.slow
def test_a_fit_goes_on_from_a_model_with_more_drives(run, fitted, folder, tmp_path):
    (tmp_path / "more").mkdir()
    shutil.copy(folder / "drives" / "rigid" / "world.npz", tmp_path / "more" / "driven.npz")
    shutil.copytree(folder / "drives" / "maps", tmp_path / "more" / "maps")
    further = fitted("--start", str(run / "model"), "--add", str(tmp_path / "more"))
    stages = {path.name for path in further.iterdir() if path.is_dir()}
    assert stages == {"nesam_rollouts", "transformer_rollouts", "gate", "model"}
    before, after = (files.load(place / "model")[1] for place in (run, further))
    for part in ("nesam", "transformer"):
        old, new = getattr(before, part), getattr(after, part)
        assert any(
            not np.array_equal(x, y)
            for x, y in zip(*map(jax.tree.leaves, (old.network, new.network)), strict=True)
        )
        chex.assert_trees_all_equal(old.replace(network=None), new.replace(network=None))
    inputs = [(place / "nesam_rollouts" / "inputs.txt").read_text() for place in (run, further)]
    assert ["driven.npz" in text for text in inputs] == [False, True]


def test_a_fit_does_not_go_on_as_another_model(run, folder, tmp_path):
    other = ("--config", folder / "tiny.yaml", "--model.coefficients", "scalar")
    message = refusal(door("fit"), *other, "--start", run / "model", "--runs", tmp_path / "runs")
    assert "coefficients='scalar'" in message and "coefficients='grouped'" in message
    assert not (tmp_path / "runs").exists()


def test_one_specialist_alone_is_fitted_and_compared(fitted, folder, tmp_path, capsys):
    parts = ["--model.parts", "transformer", "--model.terrain"]
    run = fitted(*parts, "none", "--name", "no_terrain")
    stages = {path.name for path in run.iterdir() if path.is_dir()}
    assert stages == {"transformer_single_steps", "transformer_rollouts", "model"}
    capsys.readouterr()
    command = ["prediction", "--data", str(folder / "drives" / "deformable")]
    command += ["--context", "2", "--horizons", "3", "--stride", "50", "--models", "builtin"]
    door("evaluate")([*command, "--compare", str(run)])
    assert f"| {run.name}: transformer " in capsys.readouterr().out
    with pytest.raises(CheckpointError, match="expected vertiwm, found transformer alone"):
        load_model("vertiwm", run / "model")


@pytest.mark.parametrize(
    "settings, words",
    [
        ({"parts": ()}, "at least one"),
        ({"parts": ("gate", "nesam")}, "both specialists"),
        ({"terrain": "none"}, "patches for the gate"),
        ({"parts": ("nesam",), "encoders": "shared"}, "own ones for nesam alone"),
        ({"gates": 0}, "gates: expected at least 1"),
    ],
)
def test_models_without_sense_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        ModelConfig(**settings)


def test_what_cannot_be_fitted_is_named(run, folder, tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        door("fit")(["--model.encoders", "shared", "--nesam.learns-from", "rigid"])
    said = " ".join(capsys.readouterr().err.split())  # tyro breaks lines
    assert "model.encoders: expected own ones" in said
    with pytest.raises(SystemExit, match="2"):
        door("fit")(["--model.gates", "2", "--gate.rollouts.trainable", "gate.network", "nesam"])
    said = " ".join(capsys.readouterr().err.split())
    assert "expected nothing but gates where there are 2" in said
    message = refusal(door("fit"), "--data", tmp_path, "--runs", tmp_path / "runs")
    assert "expected files of drives on rigid or deformable or mixed ground" in message
    again = shutil.copytree(run, tmp_path / "again")
    config, params = files.load(again / "model")
    other = jax.tree.map(lambda x: x + 1, params)
    files.save(again / "model", config, other)
    chex.assert_trees_all_equal(files.load(again / "model")[1], other)
    shutil.rmtree(again / "model" / "1")
    with pytest.raises(CheckpointError, match="weights of a model"):
        files.load(again / "model")
