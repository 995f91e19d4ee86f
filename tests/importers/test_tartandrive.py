"""Trajectories and folders of TartanDrive, in the layouts that its authors' converters write."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from importers.logged import SETTINGS, commands, logged

from vertiwm_jax.importers import tartandrive
from vertiwm_jax.importers.settings import Trajectories
from vertiwm_jax.learning.schema import DataError

COMMAND_TIME = 99.5 + 0.01 * np.arange(600)


@pytest.fixture
def seen():
    return logged(seconds=4)


def state(seen, width):
    return np.column_stack([seen.position, seen.rotation.as_quat(), seen.state[:, 6:]])[:, :width]


def folder(path, seen, **changes):
    """What version 2 has of odometry and commands."""
    topics = {
        "state": (seen.time, state(seen, 13)),
        "cmd": (COMMAND_TIME, commands(COMMAND_TIME)),
        **changes,
    }
    for name, (stamps, values) in topics.items():
        (path / name).mkdir(parents=True, exist_ok=True)
        np.savetxt(path / name / "interp_timestamps.txt", stamps)
        np.savetxt(path / name / "interp_data.txt", values)
    return path


def test_folders(seen, tmp_path):
    (log,) = tartandrive.read(folder(tmp_path / "run", seen), SETTINGS)
    np.testing.assert_allclose(log.time, seen.time)
    np.testing.assert_allclose(log.position, seen.state[:, :3])
    assert (log.rotation.inv() * seen.rotation).magnitude().max() < 1e-9
    np.testing.assert_allclose(log.velocity, seen.state[:, 6:9])
    np.testing.assert_allclose(log.angular_velocity, seen.state[:, 9:12])
    np.testing.assert_allclose(log.command_time, COMMAND_TIME)
    np.testing.assert_allclose(log.command, commands(COMMAND_TIME))


def test_topics_of_other_names(seen, tmp_path):
    path = folder(tmp_path / "run", seen, odometry=(seen.time, state(seen, 7)))
    settings = replace(SETTINGS, tartandrive=Trajectories(state="odometry"))
    (log,) = tartandrive.read(path, settings)
    assert log.velocity is None and log.angular_velocity is None


class Tensor:
    """As much of a torch tensor as is read."""

    def __init__(self, values):
        self._values = np.asarray(values, np.float32)

    def double(self):
        return Tensor64(self._values.astype(np.float64))


class Tensor64:
    def __init__(self, values):
        self._values = values

    def numpy(self):
        return self._values


@pytest.fixture
def stored(monkeypatch):
    """A stand-in of torch, which is large, and what its `load` gives."""
    trajectory = {}

    def load(path, map_location, weights_only):
        assert weights_only and map_location == "cpu"
        return trajectory

    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(load=load))
    return trajectory


def test_trajectories(seen, stored, tmp_path):
    count = len(seen.time)
    stored |= {
        "action": Tensor(seen.command),
        "reward": Tensor(np.zeros(count)),
        "observation": {"state": Tensor(state(seen, 7)), "imu": Tensor(np.zeros((count, 20, 6)))},
        "dt": Tensor(np.full(count, 0.1)),
    }
    (log,) = tartandrive.read(tmp_path / "a.pt", SETTINGS)
    np.testing.assert_allclose(log.time, 0.1 * np.arange(count), atol=1e-5)
    np.testing.assert_allclose(log.position, seen.state[:, :3], atol=1e-5)
    np.testing.assert_allclose(log.command, seen.command, atol=1e-6)
    assert log.velocity is None
    stored["action"] = Tensor(seen.command[:-1])
    with pytest.raises(DataError, match=rf"a.pt: action: expected shape \[{count}, 2\], found"):
        tartandrive.read(tmp_path / "a.pt", SETTINGS)
    del stored["observation"]["state"]
    with pytest.raises(DataError, match=r"a.pt: expected a dictionary of observation.state, act"):
        tartandrive.read(tmp_path / "a.pt", SETTINGS)


def test_trajectories_that_torch_has_written(seen, tmp_path):
    torch = pytest.importorskip("torch", reason="needs the extra `peers`")
    count, path = len(seen.time), tmp_path / "a.pt"
    trajectory = {
        "action": torch.tensor(seen.command),
        "observation": {"state": torch.tensor(state(seen, 13)), "imu": torch.zeros(count, 20, 6)},
        "dt": torch.full((count,), 0.1),
    }
    torch.save(trajectory, path)
    (log,) = tartandrive.read(path, SETTINGS)
    np.testing.assert_allclose(log.position, seen.state[:, :3], atol=1e-9)
    np.testing.assert_allclose(log.velocity, seen.state[:, 6:9], atol=1e-9)
    whole = path.read_bytes()
    for bad in (b"", b"no trajectory", whole[: len(whole) // 2]):
        path.write_bytes(bad)
        with pytest.raises(DataError, match=r"a.pt: expected a dictionary of observation.state"):
            tartandrive.read(path, SETTINGS)
    for other in ([torch.zeros(3)], {"observation": {"state": 3}}, {"more": SimpleNamespace()}):
        torch.save(other, path)
        with pytest.raises(DataError, match=r"a.pt: expected a dictionary of observation.state"):
            tartandrive.read(path, SETTINGS)


def test_trajectories_need_torch(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(DataError, match=r"a.pt: expected the package torch .* pip install torch"):
        tartandrive.read(tmp_path / "a.pt", SETTINGS)


def test_what_cannot_be_used_is_named(seen, tmp_path):
    path = folder(tmp_path / "run", seen, cmd=(COMMAND_TIME, np.zeros((600, 3))))
    with pytest.raises(DataError, match=r"cmd/interp_data.txt: expected shape \[600, 2\], found"):
        tartandrive.read(path, SETTINGS)
    (path / "cmd" / "interp_data.txt").write_text("no numbers")
    with pytest.raises(DataError, match="run/cmd: expected text files of numbers"):
        tartandrive.read(path, SETTINGS)
    # Rows that were never filled are infinite there.
    holed = state(seen, 13)
    holed[4] = np.inf
    path = folder(tmp_path / "holed", seen, state=(seen.time, holed))
    with pytest.raises(DataError, match=r"position: expected finite numbers, found .* in sample 4"):
        tartandrive.read(path, SETTINGS)
    np.savez(tmp_path / "a.npz", observation=np.array({"state": 0}))
    with pytest.raises(DataError, match=r"a.npz: expected a .pt trajectory"):
        tartandrive.read(tmp_path / "a.npz", SETTINGS)
    with pytest.raises(FileNotFoundError):
        tartandrive.read(folder(tmp_path / "run", seen).parent, SETTINGS)
