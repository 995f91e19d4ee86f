"""Recorded drives: the command, what it writes, and what is left when it is stopped."""

import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from doors import door, refusal

from vertiwm_jax import atomic
from vertiwm_jax.env.observation import LAYOUT
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.learning import dataset, schema
from vertiwm_jax.learning.dataset import WheelSignals
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.models.registry import load_encoders
from vertiwm_jax.simulators import chrono, collection, excitation
from vertiwm_jax.simulators.protocol import Drive, Observation, SimulatorError, drive
from vertiwm_jax.terrain import files, query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.sensing import SensingConfig

GRASS, SAND = 3, 8
STEPS = 6


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """A folder of two worlds, hilly and in part sand."""
    folder = tmp_path_factory.mktemp("maps")
    wave = np.sin(np.arange(129) / 8)
    semantic = np.full((16, 16), GRASS)
    semantic[:, 8:] = SAND
    for i in range(2):
        heights = 4 + i * np.outer(wave, wave)
        files.save(TerrainMap.from_array(heights, semantic), folder / f"map_{i}.npz")
    return folder


def run(maps, output, *argv):
    arguments = ["--output", output, "--terrain", maps, "--drives", 23, "--seconds", STEPS / 10]
    door("collect")([*map(str, arguments), *argv])


@pytest.fixture(scope="module")
def collected(maps, tmp_path_factory):
    output = tmp_path_factory.mktemp("collected") / "drives"
    run(maps, output)
    return output


def contents(folder):
    """The arrays of every file."""
    return {
        path.name: {name: array for name, array in np.load(path).items()}
        for path in sorted(folder.glob("*.npz"))
    }


def test_drives_are_read_as_recorded(collected, maps):
    drives, terrain = dataset.load_drives(collected, "all")
    assert drives.state.shape == (46, STEPS + 1, 12) and terrain.worlds == 2
    assert np.all(drives.length == STEPS)
    np.testing.assert_array_equal(terrain.elevation, files.load_map(maps).elevation)
    assert all(getattr(drives.wheels, name) is not None for name in schema.WHEEL_SIGNALS)
    assert set(np.unique(drives.wheel_class)) == {GRASS, SAND}
    control = drives.control.reshape(-1, 2)
    assert 1 <= control[:, 0].min() < control[:, 0].max() <= 4
    assert 0.2 < np.abs(control[:, 1]).max() <= 0.3726
    _, meta = schema.read(collected / "world_001.npz")
    assert (meta["map"], meta["world"], meta["simulator"]) == ("world_001.npz", 1, "builtin")
    # No two drives are the same.
    assert len(np.unique(drives.state[:, 0, 0])) == 46
    parts = [len(dataset.load_drives(collected, split)[0].state) for split in schema.SPLITS]
    assert parts == [37, 4, 5]


def test_going_on_is_as_if_never_stopped(collected, maps, tmp_path, monkeypatch, capsys):
    write, left = schema.write, []

    def stopping(path, arrays, meta, *others):
        if meta["world"] == 1:
            left.extend(path.name for path in (tmp_path / "drives").iterdir())
            raise KeyboardInterrupt
        write(path, arrays, meta, *others)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as stop:
        patch.setattr(schema, "write", stopping)
        run(maps, tmp_path / "drives")
    assert stop.value.code == 130
    assert sorted(left) == ["config.yaml", "maps", "world_000.npz"]
    before = (tmp_path / "drives" / "world_000.npz").stat().st_mtime_ns
    run(maps, tmp_path / "drives")
    assert "1 of 2 worlds are left" in capsys.readouterr().out
    assert (tmp_path / "drives" / "world_000.npz").stat().st_mtime_ns == before
    jax.tree.map(np.testing.assert_array_equal, contents(tmp_path / "drives"), contents(collected))


def test_what_cannot_be_written_leaves_nothing_half_written(maps, tmp_path, monkeypatch):
    def full(descriptor):
        raise OSError(28, "No space left on device")

    run_folder = tmp_path / "drives"
    write = atomic.write

    def write_on_a_full_disk(path, data):
        with monkeypatch.context() as patch:
            if path.name == "world_000.npz":
                patch.setattr(atomic.os, "fsync", full)
            write(path, data)

    monkeypatch.setattr(atomic, "write", write_on_a_full_disk)
    argv = ("--output", run_folder, "--terrain", maps, "--drives", 1, "--seconds", 0.1)
    assert "No space left" in refusal(door("collect"), *argv)
    assert sorted(path.name for path in run_folder.iterdir()) == ["config.yaml", "maps"]


def test_another_command_does_not_go_on(collected, maps, tmp_path):
    argv = ("--output", collected, "--terrain", maps, "--seconds", STEPS / 10)
    message = refusal(door("collect"), *argv, "--drives", 22)
    assert message.endswith("config.yaml: drives: expected 23 as before, found 22")
    (tmp_path / "file").touch()
    message = refusal(door("collect"), "--output", tmp_path, "--terrain", maps)
    assert "expected a new folder" in message
    assert "none: file: expected" in refusal(
        door("collect"), "--output", tmp_path / "new", "--terrain", maps / "none"
    )
    with pytest.raises(SystemExit) as stop:
        door("collect")(["--output", str(tmp_path), "--obstacles", "True"])
    assert stop.value.code == 2


def test_chrono_that_is_missing_is_named(tmp_path, monkeypatch):
    def missing(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(chrono.importlib, "import_module", missing)
    message = refusal(door("collect"), "--output", tmp_path / "drives", "--simulator", "chrono")
    assert "conda install -c projectchrono" in message and "PyPI is something else" in message
    assert not (tmp_path / "drives").exists()
    navigate = ("navigation", "--policy", "straight", "--simulator", "chrono")
    assert refusal(door("evaluate"), *navigate) == message


def test_drives_that_end_early_are_tried_again(maps, monkeypatch):
    lengths, tried = iter([1, 3, 2, 0, 1, 2, 0, 0, 0, 0, 0, 0]), []

    def short(simulator, start, pilot, steps, over):
        tried.append(start)
        return Drive([], np.zeros((next(lengths), 2)), "rolled over")

    monkeypatch.setattr(collection, "drive", short)
    command = collection.CollectConfig(output=maps, seconds=1.0)
    first = command, vehicle.load("hmmwv"), None, (files.load_map(maps), 0, 0)
    assert len(collection.record(*first).control) == 3 and len(set(tried)) == 6
    with pytest.raises(SimulatorError, match="world 0: drive 0: expected a step or more"):
        collection.record(*first)


class Scripted:
    """Goes through states whatever is commanded."""

    def __init__(self, states):
        self._states = iter(states)

    def start(self, x, y, yaw):
        return self.step(np.zeros(2))

    def step(self, command):
        state = np.asarray(next(self._states), np.float32)
        return Observation(state, np.zeros(4, np.uint8), WheelSignals())


@pytest.mark.parametrize(
    ("index", "value", "ending", "length"),
    [
        (0, 61.5, "left the map", 3),
        (3, 1.4, "rolled over", 3),
        (6, np.nan, "diverged", 2),
        (7, 60.0, "diverged", 2),
        (0, 60.0, "time", 5),
    ],
)
def test_endings(maps, tmp_path, index, value, ending, length):
    states = np.zeros((6, 12))
    states[3:, index] = value
    level = files.load_map(maps / "map_0.npz")
    pilot = excitation.sinusoids(np.random.default_rng(0), 5, 0.3725)
    over = partial(collection.ending, *excitation.within(level, 3.0))
    found = drive(Scripted(states), (0, 0, 0), pilot, 5, over)
    assert (found.ending, len(found.control), len(found.observations)) == (
        ending, length, length + 1,
    )  # fmt: skip
    arrays, wheels = collection.arrays([found], 5), load_vehicle().wheel_position
    schema.write(tmp_path / "a.npz", arrays, {"map": "a"}, wheels)
    file = np.load(tmp_path / "a.npz")
    assert file["length"] == [length] and file["state"].shape == (1, 6, 12)
    assert json.loads(str(file["meta"]))["dt"] == 0.1


def test_starts_are_level_roomy_and_near_borders(maps):
    boxes = np.stack([np.zeros(16), np.linspace(-60, 60, 16), *np.ones((3, 16))], -1)
    steep = np.broadcast_to(np.maximum(np.arange(129.0) - 100, 0) * 0.5, (129, 129))
    semantic = np.full((16, 16), GRASS)
    semantic[:, 6:8] = SAND
    terrain = TerrainMap.from_array(steep, semantic, obstacles=boxes)
    for seed in range(20):
        x, y, yaw = excitation.start(np.random.default_rng(seed), terrain, 16.0)
        assert abs(x) <= 59 and abs(y) <= 59 and x < 38
        assert np.hypot(boxes[:, 0] - x, boxes[:, 1] - y).min() >= 8
        end = np.array([x, y]) + 39 * np.array([np.cos(yaw), np.sin(yaw)])
        assert np.all(np.abs(end) <= 59.1)
        way = np.linspace(x, end[0], 50)
        assert 0.05 < np.mean((way > -16) & (way < 0)) < 0.95
    slope = np.broadcast_to(0.4 * np.arange(65.0), (65, 65))
    steep = TerrainMap.from_array(slope, np.full((8, 8), GRASS))
    with pytest.raises(SimulatorError, match="20 degrees or less"):
        excitation.start(np.random.default_rng(0), steep, 16.0)


class AtGoal:
    """Asks for half speed, and steers by the bearing of the goal; is shown `size` numbers."""

    def __init__(self, size):
        self.size = size

    def __call__(self, observation, key):
        assert observation.shape == (self.size,)
        return jnp.stack([0.0 * observation[8], observation[10]])


class Ahead:
    """Draws goals 30 m to the east of the middle of the map."""

    @staticmethod
    def uniform(low, high, shape):
        return np.broadcast_to([30.0, 0.0], shape)


@pytest.mark.parametrize("encoders", [None, load_encoders()], ids=["arcs", "embeddings"])
def test_a_policy_drives_from_goal_to_goal(maps, encoders):
    terrain = files.load_map(maps / "map_0.npz")
    config = NavigationConfig(speed_range=(0.0, 5.0), embeddings=encoders is not None)
    policy = jax.tree_util.Partial(AtGoal(config.observed.size))
    rng = np.random.default_rng(0)
    learned = policy, config, encoders
    pilot = collection.to_goals(learned, load_vehicle(), terrain, (0.0, 0.0, 0.0), rng)
    height = float(query.height(terrain, jnp.zeros(2)))
    state, goals = np.array([0, 0, height, *np.zeros(9)], np.float32), []
    for _ in range(3):
        command = pilot(state)
        goal = np.asarray(pilot.state.goal)
        goals.append(goal)
        offset = goal - state[:3]
        bearing = np.arctan2(offset[1], offset[0]) - state[5]
        np.testing.assert_allclose(command, [2.5, 0.3725 * np.sin(bearing)], atol=1e-3)
        np.testing.assert_array_equal(pilot(state), command)
        state = np.append(goal, np.zeros(9)).astype(np.float32)
    assert np.linalg.norm(np.diff(goals, axis=0), axis=-1).min() >= 20
    command = collection.CollectConfig(output=maps, seconds=2.0)
    alone = jax.device_get(terrain.subset(np.array([0])))
    found = collection.record(command, vehicle.load("hmmwv"), learned, (alone, 0, 1))
    assert found.control.shape == (20, 2) and np.all(found.control[:, 0] == 2.5)


def test_a_policy_sees_as_far_as_it_did_in_training():
    """Of hills, one that sees 12 m observes what the level ground around it suggests."""
    hills = np.zeros((129, 129))
    hills[:, 80:] = 3.0
    terrain = TerrainMap.from_array(hills, np.full((16, 16), GRASS))
    heights, way = LAYOUT["height"].where, LAYOUT["route"].where
    policy = jax.tree_util.Partial(
        lambda seen, key: jnp.stack([seen[heights].mean(), seen[way.start] / 10])
    )
    state = np.array([0, 0, 0.5, *np.zeros(9)], np.float32)
    acted = {}
    for sight in (12.0, np.inf):
        config = NavigationConfig(sensing=SensingConfig(range=sight))
        learned = policy, config, None
        pilot = collection.to_goals(learned, load_vehicle(), terrain, state[[0, 1, 5]], Ahead)
        pilot(state)
        assert (pilot.state.observed is None) == np.isinf(sight)
        acted[sight] = np.asarray(pilot.action)
    assert acted[np.inf][0] - acted[12.0][0] > 0.05
    # Of two who look at the same hills one knows that the way up costs more than its length.
    assert acted[np.inf][1] > 0.01 > abs(acted[12.0][1])


def test_a_rover_drives_at_full_size(maps, tmp_path):
    # The ground of the maps is so small to it that it is 1280 m at full size.
    flat = TerrainMap.from_array(np.full((129, 129), 0.3), np.full((16, 16), SAND))
    (tmp_path / "maps").mkdir()
    files.save(flat, tmp_path / "maps" / "map.npz")
    run(tmp_path / "maps", tmp_path / "drives", "--vehicle", "rover", "--drives", "1")
    drives, terrain = dataset.load_drives(tmp_path / "drives", "train")
    assert terrain.resolution == 10.0 and np.all(terrain.elevation == 3.0)
    rover = vehicle.load("rover").vehicle
    _, meta = schema.read(tmp_path / "drives" / "world_000.npz")
    np.testing.assert_allclose(meta["vehicle"]["wheels_in_body_xy"], rover.wheel_position)
    assert meta["scale"] == 10
    resting = rover.wheel_radius - rover.travel_at_rest.mean()
    np.testing.assert_allclose(drives.state[..., 2] - 3.0, resting, atol=0.15)
    message = refusal(
        door("collect"), "--output", tmp_path / "drives", "--terrain", tmp_path / "maps"
    )
    assert message.endswith("config.yaml: vehicle: expected rover as before, found hmmwv")
    for argv in (["--vehicle", "rovr"], ["--vehicle", "husky", "--simulator", "chrono"]):
        with pytest.raises(SystemExit) as stop:
            door("collect")(["--output", str(tmp_path / "other"), *argv])
        assert stop.value.code


@pytest.mark.slow
def test_several_processes_record_the_same(collected, maps, tmp_path):
    run(maps, tmp_path / "drives", "--jobs", "2")
    jax.tree.map(np.testing.assert_array_equal, contents(tmp_path / "drives"), contents(collected))
