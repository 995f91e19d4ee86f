"""The command that shows drives, from end to end."""

import subprocess
import sys

import numpy as np
import pytest
from doors import door, refusal, untrained
from learning import recordings
from PIL import Image
from viewing.test_recording import read

from vertiwm_jax.cli import view
from vertiwm_jax.mechanics.kinematic import ConstantVelocity
from vertiwm_jax.rl.experiment import SACTraining
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import TerrainMap

TINY = """
ground: {train_worlds: 2, suites: [easy], suite_worlds: 1, starts: 8, pairs: 2}
simulator: {substeps: 1}
model: builtin
navigation: {horizon_seconds: 2, settle_steps: 1}
loop: {seeds: 2}
sac:
  {total_timesteps: 64, num_envs: 8, num_steps: 8, batch: 8, buffer_size: 64, learning_starts: 64,
  hidden: [8]}
"""


@pytest.fixture
def uniform(monkeypatch):
    """Models by name are one that compiles in no time."""
    monkeypatch.setattr(view, "load_model", lambda name, weights, **_: (ConstantVelocity(), None))


def test_a_recorded_drive(uniform, tmp_path, capsys, monkeypatch):
    path = recordings.write(tmp_path)
    argv = [str(path), "--drive", "4"]
    door("view")(argv)
    recording, said = tmp_path / "a-drive-4.rrd", capsys.readouterr().out
    assert "a, drive 4, and vertiwm" in said and said.endswith(f"look at it:\nrerun {recording}\n")
    vehicle = read(recording)[0]["world/vehicle"]
    expected = recordings.drives()["state"][4, :, :3]
    np.testing.assert_allclose(np.squeeze(vehicle["Transform3D:translation"]), expected)
    opened = []
    monkeypatch.setattr(subprocess, "call", lambda argv: opened.append(argv) or 3)
    other = tmp_path / "other.rrd"
    message = refusal(door("view"), *argv, "--output", other, "--open")
    assert opened[0][1:] == ["-m", "rerun", str(other)] and other.is_file()
    assert message.endswith("other.rrd: the rerun viewer ended with status 3")
    door("view")([*argv, "--movie", str(tmp_path / "a.gif")])
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == recordings.STEPS / 2 + 1
    names = {"a.npz", "maps", "a-drive-4.rrd", "other.rrd", "a.gif"}
    assert {path.name for path in tmp_path.iterdir()} == names


def test_maps_are_drawn_beside_them(tmp_path, capsys):
    level = TerrainMap.from_array(np.zeros((33, 33)), np.full((4, 4), 3))
    for name in ("a", "b"):
        files.save(level, tmp_path / f"{name}.npz")
    for source, drawn in (("a.npz", "a.png"), ("", "maps.png")):
        door("view")([str(tmp_path / source)])
        assert str(tmp_path / drawn) in capsys.readouterr().out
        with Image.open(tmp_path / drawn) as image:
            assert image.format == "PNG"


def test_another_vehicle_is_shown_as_large_as_it_is(uniform, tmp_path):
    path = recordings.write(tmp_path)
    for name, wheelbase in ((None, 3.302), ("rover", 3.12)):
        scene = view._scene(view.View(path, vehicle=name))
        np.testing.assert_allclose(scene.vehicle.wheelbase, wheelbase, rtol=1e-5)
    assert "did you mean 'rover'" in refusal(door("view"), path, "--vehicle", "rovr")


@pytest.mark.slow
def test_a_policy_on_a_held_out_task(tmp_path, capsys):
    (tmp_path / "config.yaml").write_text(TINY)
    untrained(SACTraining, tmp_path)
    argv = [str(tmp_path), "--model", "builtin", "--suite", "obstacles", "--seed", "1"]
    door("view")([*argv, "--task", "1"])
    assert "sac, seed 1 in builtin: timed out, 2.0 s" in capsys.readouterr().out
    entities, _ = read(tmp_path / "obstacles-1-builtin.rrd")
    assert entities["world/vehicle"]["step"] == list(range(21))
    assert {"world/goal", "world/obstacles"} <= set(entities)
    assert any("sinkage" in entity for entity in entities)
    assert "task: expected 0 to 1, found 2" in refusal(door("view"), *argv, "--task", 2)
    assert "drive: is of a file" in refusal(door("view"), *argv, "--drive", 0)
    (tmp_path / "policy").rename(tmp_path / "gone")
    assert "expected the folder of a trained policy" in refusal(door("view"), *argv)


def test_without_rerun(tmp_path, monkeypatch):
    path = recordings.write(tmp_path)
    monkeypatch.delitem(sys.modules, "vertiwm_jax.viewing.recording", raising=False)
    monkeypatch.setitem(sys.modules, "rerun", None)
    message = refusal(door("view"), path)
    assert "drive-0.rrd: expected" in message and '"vertiwm-jax[view]"' in message


def test_what_cannot_be_shown_is_named(uniform, tmp_path, capsys):
    path = recordings.write(tmp_path)
    (tmp_path / "empty").mkdir()
    before = {path.name for path in tmp_path.iterdir()}
    assert "a.npz: suite: is of a policy" in refusal(door("view"), path, "--suite", "easy")
    assert "drive: expected 0 to 24, found 99" in refusal(door("view"), path, "--drive", 99)
    assert "none.npz: " in refusal(door("view"), tmp_path / "none.npz")
    assert "empty/config.yaml: no such file" in refusal(door("view"), tmp_path / "empty")
    nowhere = tmp_path / "none" / "a.rrd"
    assert "none/a.rrd: expected a folder" in refusal(door("view"), path, "--output", nowhere)
    assert {path.name for path in tmp_path.iterdir()} == before
    for options in (["--movie", "a.mp4"], ["--movie", "a.gif", "--open"]):
        with pytest.raises(SystemExit) as stop:
            door("view")([str(path), *options])
        assert stop.value.code == 2
    found = capsys.readouterr().err
    assert "expected the ending .gif, found .mp4" in found and "leave out output" in found
