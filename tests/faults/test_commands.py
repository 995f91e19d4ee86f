"""Commands refuse at once, in words that help, what they cannot do."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from doors import door, refusal
from faults.border import fault
from learning import recordings

from vertiwm_jax.evaluation import calibration, prediction, report
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning import experiment as fitting
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.rl import experiment
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import TerrainMap

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


@fault(DataError, "the split is by number, so that few drives are all trained on")
def test_few_drives_are_split_by_share(tmp_path):
    recordings.write(tmp_path, **recordings.drives(count=10))
    found = [dataset.load_drives(tmp_path, split)[0].state for split in dataset.SPLITS]
    # The speed tells the drive.
    speeds = np.concatenate([np.asarray(state)[:, 0, 6] for state in found])
    np.testing.assert_allclose(np.sort(speeds), 1 + 0.1 * np.arange(10), rtol=1e-6)
    assert len(found[0]) >= 6


@fault(Begun, "that nothing can be tested on is told when the first model has been fitted")
def test_too_few_drives_are_refused_before_a_run_begins(tmp_path, monkeypatch):
    recordings.write(tmp_path, **recordings.drives(count=1))
    monkeypatch.setattr(fitting.Run, "begin", begin)
    assert str(tmp_path) in refusal(door("fit"), "--data", tmp_path, "--runs", tmp_path / "runs")


@pytest.mark.parametrize("algorithm", ["ppo", "sac", "td3"])
@pytest.mark.parametrize("name", ["file", "file/runs"])
@fault(Begun, "that no run folder can be made is told when vehicles have been placed")
def test_an_unwritable_run_folder_is_refused_first(tmp_path, monkeypatch, algorithm, name):
    (tmp_path / "file").touch()
    monkeypatch.setattr(experiment, "training_ground", begin)
    message = refusal(door(algorithm), "--runs", tmp_path / name)
    assert f"{tmp_path / name}: cannot start a run there" in message


@pytest.mark.parametrize("command", ["navigation", "prediction", "calibration"])
@fault(Begun, "that tables cannot be written is told when all has been computed")
def test_an_unwritable_output_is_refused_first(tmp_path, monkeypatch, command):
    (tmp_path / "file").touch()
    recordings.write(tmp_path, **recordings.drives())
    for place, name in (
        (report, "drive"),
        (prediction, "predict"),
        (calibration, "signs"),
    ):
        monkeypatch.setattr(place, name, begin)
    driven = {"navigation": ["--policy", "straight", "--terrain", maps(tmp_path / "large", 129)]}
    data = driven.get(command, ["--data", tmp_path])
    message = refusal(door("evaluate"), command, *data, "--output", tmp_path / "file")
    assert str(tmp_path / "file") in message


SMALL = {
    "evaluate": (door("evaluate"), ["navigation", "--policy", "straight"]),
    "ppo": (door("ppo"), ["--model", "builtin"]),
}


@pytest.mark.parametrize("name", SMALL)
@fault(AssertionError, "a map that is too small is told as tasks that cannot be driven")
def test_a_map_that_is_too_small_is_called_so(tmp_path, name):
    command, argv = SMALL[name]
    small = maps(tmp_path / "worlds", size=21, count=5)
    message = refusal(command, *argv, "--terrain", small).removeprefix("error: ")
    # Its name and its size, and not the coordinates of a task.
    assert message.startswith(str(small)) and "20" in message.removeprefix(str(small))
    assert "tasks." not in message


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
@fault(TimeoutError, "JAX waits for threads that a forked process does not have")
def test_a_forked_process_says_that_it_cannot_go_on(forked, command):
    if forked[command] is None:
        raise TimeoutError(command)
    assert "spawn" in forked[command] and "\n" not in forked[command]
