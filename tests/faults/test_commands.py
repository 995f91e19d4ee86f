"""Commands refuse at once, in words that help, what they cannot do."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from doors import door, refusal
from learning import recordings

from vertiwm_jax import config
from vertiwm_jax.cli import view
from vertiwm_jax.env.navigation import make_env
from vertiwm_jax.evaluation import calibration, compare, prediction, prediction_report, report
from vertiwm_jax.importers import imports
from vertiwm_jax.learning import dataset, identification
from vertiwm_jax.learning import experiment as fitting
from vertiwm_jax.rl import experiment
from vertiwm_jax.simulators import collection
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import MapError, TerrainMap

GRASS = 3
TESTS = Path(__file__).resolve().parents[1]


class Begun(Exception):
    """What takes long has begun."""


def begin(*_, **__):
    raise Begun


def maps(folder, size, count=1):
    folder.mkdir()
    for i in range(count):
        level = TerrainMap.from_array(np.ones((size, size)), np.full((4, 4), GRASS))
        files.save(level, folder / f"map_{i}.npz")
    return folder


def test_few_drives_are_split_by_share(tmp_path):
    recordings.write(tmp_path, **recordings.drives(count=10))
    found = [dataset.load_drives(tmp_path, split)[0].state for split in dataset.SPLITS]
    # The speed tells the drive.
    speeds = np.concatenate([np.asarray(state)[:, 0, 6] for state in found])
    np.testing.assert_allclose(np.sort(speeds), 1 + 0.1 * np.arange(10), rtol=1e-6)
    assert len(found[0]) >= 6


def test_too_few_drives_are_refused_before_a_run_begins(tmp_path, monkeypatch):
    recordings.write(tmp_path, **recordings.drives(count=1))
    monkeypatch.setattr(fitting.Run, "begin", begin)
    message = refusal(door("fit"), "--data", tmp_path, "--runs", tmp_path / "runs")
    told = f"error: {tmp_path}: 1 drives: 1 train, 0 validation, 0 test (too few to share out): "
    assert message.startswith(told) and "resampling.longest" in message


def test_drives_that_are_too_short_are_refused_before_a_run_begins(tmp_path, monkeypatch):
    recordings.write(tmp_path, **recordings.drives(count=10, steps=31))
    monkeypatch.setattr(fitting.Run, "begin", begin)
    message = refusal(door("fit"), "--data", tmp_path, "--runs", tmp_path / "runs")
    assert message.startswith(f"error: {tmp_path}: 10 drives: ")
    assert "at least 32 steps in the train split, found at most 31" in message


def windows(folder, *argv):
    """How many windows are predicted; a drive has one."""
    file = folder / "errors.json"
    words = ["--data", folder, "--models", "builtin", "--json", file, *argv]
    door("evaluate")(["prediction", *map(str, words)])
    return json.loads(file.read_text())[0]["windows"]


@pytest.mark.parametrize(
    ("count", "told"),
    [
        (1, "1 drives: 1 train, 0 validation, 0 test (too few to share out); predicted: all"),
        (10, "10 drives: 8 train, 1 validation, 1 test (by share of drives); predicted: test"),
    ],
)
def test_a_small_import_is_predicted(tmp_path, capsys, count, told):
    recordings.write(tmp_path, **recordings.drives(count=count))
    assert windows(tmp_path) == 1
    assert f"{tmp_path}: {told}\n" in capsys.readouterr().out


def test_all_drives_are_predicted_where_that_is_asked_for(tmp_path):
    recordings.write(tmp_path, **recordings.drives(count=10))
    assert windows(tmp_path, "--split", "all") == 10


def test_shares_are_set_and_told(tmp_path, capsys):
    recordings.write(tmp_path, **recordings.drives(count=10))
    shares = ["--splits.shares", "0.5", "0.2", "0.3"]
    assert windows(tmp_path, *shares) == 3
    assert "10 drives: 5 train, 2 validation, 3 test" in capsys.readouterr().out


@pytest.mark.parametrize("test", ["calibration", "prediction"])
def test_a_split_without_drives_is_refused_before_models_are_read(tmp_path, monkeypatch, test):
    recordings.write(tmp_path, **recordings.drives(count=10), split=np.repeat("train", 10))
    for place in (calibration, prediction_report):
        monkeypatch.setattr(place, "load_model", begin)
    message = refusal(door("evaluate"), test, "--data", tmp_path)
    assert message.startswith(f"error: {tmp_path}: 10 drives: 10 train, 0 validation, 0 test")
    assert "(as files say)" in message


@pytest.mark.parametrize("algorithm", ["ppo", "sac", "td3"])
@pytest.mark.parametrize("name", ["file", "file/runs"])
def test_an_unwritable_run_folder_is_refused_first(tmp_path, monkeypatch, algorithm, name):
    (tmp_path / "file").touch()
    monkeypatch.setattr(experiment, "training_ground", begin)
    message = refusal(door(algorithm), "--runs", tmp_path / name)
    assert f"{tmp_path / name}: cannot start a run there" in message


@pytest.mark.parametrize("command", ["navigation", "prediction", "calibration"])
def test_an_unwritable_output_is_refused_first(tmp_path, monkeypatch, command):
    (tmp_path / "file").touch()
    recordings.write(tmp_path, **recordings.drives())
    for place, name in (
        (report, "drive"),
        (prediction, "predict"),
        (calibration, "predict"),
    ):
        monkeypatch.setattr(place, name, begin)
    driven = {"navigation": ["--policy", "straight", "--terrain", maps(tmp_path / "large", 129)]}
    data = driven.get(command, ["--data", tmp_path])
    message = refusal(door("evaluate"), command, *data, "--output", tmp_path / "file")
    assert str(tmp_path / "file") in message


SMALL = {
    "evaluate": (door("evaluate"), ["navigation", "--policy", "straight"]),
    "ppo": (door("ppo"), ["--model", "builtin"]),
    "collect": (door("collect"), ["--output", "DRIVES"]),
}


@pytest.mark.parametrize("name", SMALL)
def test_a_map_that_is_too_small_is_called_so(tmp_path, name):
    command, argv = SMALL[name]
    side = 10 if name == "collect" else 20
    small = maps(tmp_path / "worlds", size=side + 1, count=5)
    message = refusal(command, *argv, "--terrain", small).removeprefix("error: ")
    # Its name and its size, and not the coordinates of a task.
    assert message.startswith(str(small))
    found = message.removeprefix(str(small))
    assert "size: expected at least" in found and f"found {side} m x {side} m" in found
    assert "tasks." not in message


def test_the_smallest_map_holds_tasks(tmp_path):
    door("evaluate")(
        ["navigation", "--policy", "straight", "--terrain", str(maps(tmp_path / "worlds", 33))]
    )
    small = TerrainMap.from_array(np.ones((21, 21)))
    with pytest.raises(MapError, match=r"^map: size: expected at least 32 m x 32 m"):
        make_env(small)


@pytest.fixture(scope="module")
def forked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("forked")
    path = os.pathsep.join([str(TESTS.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    words = [TESTS / "faults" / "forked.py", maps(folder / "maps", 33), folder / "drives", "5"]
    found = subprocess.run(
        [sys.executable, *map(str, words)],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return json.loads(found.stdout.splitlines()[-1])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
@pytest.mark.parametrize("command", ["collect", "evaluate"])
def test_a_forked_process_says_that_it_cannot_go_on(forked, command):
    assert forked[command] and "spawn" in forked[command] and "\n" not in forked[command]


def test_identify_without_drives_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        door("identify")(["--output", str(tmp_path / "mine.yaml")])
    assert stop.value.code == 2
    assert "drives: expected at least one, found none" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["file/mine.yaml", "none/mine.yaml", "."])
def test_identify_refuses_first_what_it_cannot_write(tmp_path, monkeypatch, name):
    (tmp_path / "file").touch()
    monkeypatch.setattr(identification, "identify", begin)
    message = refusal(door("identify"), tmp_path, "--output", tmp_path / name)
    assert str(tmp_path / name) in message


def test_collect_refuses_first_what_it_cannot_write(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(collection, "_terrain", begin)
    message = refusal(door("collect"), "--output", tmp_path / "file" / "drives")
    assert message.startswith(f"error: {tmp_path / 'file' / 'drives'}: cannot write there")


@pytest.mark.parametrize("kind", ["maps", "drives"])
def test_view_refuses_first_what_it_cannot_write(tmp_path, monkeypatch, kind):
    (tmp_path / "file").touch()
    recordings.write(tmp_path)
    monkeypatch.setattr(view, "_scene", begin)
    monkeypatch.setattr(view.maps, "draw", begin)
    source = {"maps": tmp_path / "maps", "drives": tmp_path / "a.npz"}[kind]
    output = tmp_path / "file" / "shown.rrd"
    message = refusal(door("view"), source, "--output", output)
    assert message.startswith(f"error: {output}: expected a folder {tmp_path / 'file'} to write to")


def test_view_of_nothing_is_refused(tmp_path):
    message = refusal(door("view"), tmp_path / "none")
    assert message == (
        f"error: {tmp_path / 'none'}: expected maps, a run or a file of drives, found none"
    )


@pytest.mark.parametrize("test", ["prediction", "floor"])
def test_an_unwritable_file_of_errors_is_refused_first(tmp_path, monkeypatch, test):
    recordings.write(tmp_path)
    monkeypatch.setattr(dataset, "load_drives", begin)
    file = tmp_path / "none" / "errors.json"
    message = refusal(door("evaluate"), test, "--data", tmp_path, "--json", file)
    assert message.startswith(f"error: {file}: expected a folder")


@pytest.mark.parametrize("test", ["calibration", "prediction"])
def test_missing_weights_are_told_before_drives_are_read(tmp_path, monkeypatch, test):
    recordings.write(tmp_path, **recordings.drives(count=10))
    monkeypatch.setattr(dataset, "load_drives", begin)
    weights = tmp_path / "none"
    message = refusal(door("evaluate"), test, "--data", tmp_path, "--weights", weights)
    assert message.startswith(f"error: {weights}")


def test_a_seed_below_0_is_refused(tmp_path, capsys):
    data = ["--data", tmp_path]
    for name, *argv in (
        ["ppo"], ["compare"], ["fit", *data], ["collect", "--output", tmp_path / "drives"],
        ["evaluate", "floor", *data], ["evaluate", "navigation", "--policy", "straight"],
    ):  # fmt: skip
        with pytest.raises(SystemExit):
            door(name)([str(word) for word in (*argv, "--seed=-1")])
        assert "seed: expected at least 0, found -1" in capsys.readouterr().err, name


def test_a_misspelt_planner_is_refused_with_what_there_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = refusal(door("evaluate"), "navigation", "--policy", "mpi")
    assert message == (
        "error: policy: expected the folder of a run or one of straight, random, mppi, shooting; "
        "did you mean 'mppi'?, found mpi"
    )


@pytest.mark.parametrize("name", ["ppo", "compare"])
def test_missing_weights_are_told_before_worlds_are_drawn(tmp_path, monkeypatch, name):
    monkeypatch.setattr(experiment, "training_ground", begin)
    monkeypatch.setattr(compare.Run, "begin", begin)
    weights = tmp_path / "none"
    argv = ["--weights", weights, "--runs", tmp_path / "runs"]
    if name == "compare":
        for kind in ("ppo", "sac", "td3"):
            shipped = config.default_config(kind).read_text(encoding="utf-8")
            (tmp_path / f"{kind}.yaml").write_text(f"{shipped}\nweights: {weights}\n")
        argv = ["--settings", tmp_path, "--runs", tmp_path / "runs"]
    assert str(weights) in refusal(door(name), *argv)


@pytest.mark.parametrize("ending", [".bag", ".parquet"])
def test_a_missing_extra_is_told_before_logs_are_read(tmp_path, monkeypatch, ending):
    (tmp_path / "a.csv").touch()
    (tmp_path / f"b{ending}").touch()
    settings = tmp_path / "settings.yaml"
    settings.write_text("vehicle: {wheelbase: 2, track: 1}\n")
    monkeypatch.setattr(imports.table, "read", begin)
    monkeypatch.setitem(imports.READERS, ".csv", begin)
    for package in ("rosbags", "pyarrow"):
        monkeypatch.setitem(sys.modules, package, None)
    message = refusal(
        door("import_drives"),
        *[tmp_path / "a.csv", tmp_path / f"b{ending}", "--output", tmp_path / "drives"],
        *["--settings", settings, "--map", tmp_path / "map.npz"],
    )
    assert 'pip install "vertiwm-jax[logs]"' in message and f"b{ending}: " in message


def test_settings_of_another_collection_are_told_before_worlds_are_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(collection, "_terrain", begin)
    (tmp_path / "other.txt").touch()
    assert "expected a new folder" in refusal(door("collect"), "--output", tmp_path)
