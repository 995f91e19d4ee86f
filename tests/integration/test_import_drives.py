"""Logs become a collection that fitting and testing read: the command."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from doors import door, refusal, squeezed
from importers.bags import Bag
from importers.logged import SETTINGS, VEHICLE, errors, logged, rms, terrain

from vertiwm_jax import config
from vertiwm_jax.importers.settings import (
    Frames,
    GridMapSettings,
    ImportSettings,
    Resampling,
    Table,
    Topics,
)
from vertiwm_jax.learning import dataset, schema, windows
from vertiwm_jax.terrain import files

SECONDS, STEPS = 100.5, 40
GRASS = 3


@pytest.fixture(scope="module")
def seen():
    return logged(seconds=SECONDS, noise=1)


def write_csv(path, seen, **changes):
    columns = {
        "t": seen.time,
        **{axis: seen.position[:, i] for i, axis in enumerate("xyz")},
        **{f"q{axis}": seen.rotation.as_quat()[:, i] for i, axis in enumerate("xyzw")},
        "speed": seen.command[:, 0],
        "steer": seen.command[:, 1],
        **changes,
    }
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory, seen):
    """A log, settings and a map to import it by."""
    folder = tmp_path_factory.mktemp("logs")
    write_csv(folder / "loops.csv", seen)
    table = Table("t", ("x", "y", "z"), "speed", "steer", quaternion=("qx", "qy", "qz", "qw"))
    settings = replace(SETTINGS, table=table, resampling=Resampling(shortest=20, longest=STEPS))
    config.save(settings, folder / "settings.yaml")
    files.save(terrain(), folder / "level.npz")
    return folder


def arguments(folder, output, source="loops.csv", settings="settings.yaml"):
    return (folder / source, "--output", output, "--settings", folder / settings)


def run(*argv):
    door("import_drives")([str(word) for word in argv])


def test_a_log_becomes_a_collection(folder, seen, tmp_path, capsys):
    run(*arguments(folder, tmp_path / "drives"), "--map", folder / "level.npz")
    out = capsys.readouterr().out
    assert f"{folder}/loops.csv" in out
    assert "| velocity, angular velocity | 26 | 1,004 | - |" in squeezed(out)
    assert f"python -m vertiwm_jax.fit --data {tmp_path / 'drives'}" in out
    names = sorted(path.name for path in (tmp_path / "drives").iterdir())
    assert names == ["drives.npz", "maps"]
    drives, ground = dataset.load_drives(tmp_path / "drives", "test")
    np.testing.assert_array_equal(ground.elevation[0], terrain().elevation[0])
    assert drives.state.shape[0] == 3 and (np.asarray(drives.wheel_class) == GRASS).all()
    # Drive 22 begins where its share of all steps lies, and the others go on from there.
    start = seen.time[0] + 0.1 * int(22 * 1004 / 26)
    for state, length in zip(np.asarray(drives.state), drives.length, strict=True):
        at = start + 0.1 * np.arange(length + 1)
        error = errors(state[: length + 1], at)
        np.testing.assert_array_less(rms(error), (0.012, 0.0025, 0.03, 0.006))
        start = at[-1]
    cut = windows.gather(drives, windows.index(drives, ground, context=8, horizon=8))
    assert cut.state.shape[1:] == (17, 12) and np.isfinite(cut.state).all()
    _, meta = schema.read(tmp_path / "drives" / "drives.npz")
    assert meta["vehicle"]["wheels_in_body_xy"] == VEHICLE.wheels_in_body_xy
    assert meta["map"] == "map.npz" and meta["sources"] == [str(folder / "loops.csv")]


def test_a_bag_brings_its_own_ground(seen, tmp_path, capsys):
    short = replace(seen, time=seen.time[:500])
    x, y = np.meshgrid(25 - 0.5 * np.arange(101), 15 - 0.5 * np.arange(61), indexing="ij")
    with Bag(tmp_path / "drive") as bag:
        bag.odometry(short)
        bag.ackermann(seen.time[:500], seen.command[:500])
        bag.grid_map(101.0, {"elevation": 2 + 0.02 * x + 0.01 * y}, (0, 0), 0.5)
    topics = Topics("/odom", "/cmd", grid_map=GridMapSettings("/map", ground="sand"))
    frames = replace(SETTINGS.frames, origin=(0.0, 0.0, -3.0))
    config.save(replace(SETTINGS, rosbag=topics, frames=frames), tmp_path / "bag.yaml")
    run(*arguments(tmp_path, tmp_path / "drives", "drive", "bag.yaml"))
    out = capsys.readouterr().out
    assert "| - | 1 | " in squeezed(out) and "0% of the map had no height" in out
    assert "1 drives can be tested on, but are too few to fit to" in out
    drives, ground = dataset.load_drives(tmp_path / "drives", "train")
    assert float(ground.elevation.min()) == pytest.approx(5 - 0.5 - 0.15, abs=1e-5)
    sand = ground.class_names.index("sand")
    assert (np.asarray(drives.wheel_class) == sand).all()
    at = seen.time[0] + 0.1 * np.arange(drives.length[0] + 1)
    lifted = np.asarray(drives.state[0]) - np.eye(12)[2] * 3.0
    np.testing.assert_array_less(rms(errors(lifted, at)), (0.012, 0.0025, 1e-3, 1e-3))


def test_what_was_left_out_is_told(folder, seen, tmp_path, capsys):
    write_csv(folder / "far.csv", replace(seen, position=seen.position + 15.0 * np.eye(3)[0]))
    run(*arguments(folder, tmp_path / "drives", "far.csv"), "--map", folder / "level.npz")
    out = capsys.readouterr().out
    drives, _ = dataset.load_drives(tmp_path / "drives", "train")
    # x = 15 + 20 sin(0.15 t) is beyond 30 m while the sine is above 0.75.
    assert " off the map |" in squeezed(out)
    assert np.asarray(drives.state)[..., 0].max() <= 30


def test_velocities_of_another_frame_are_told_apart(folder, seen, tmp_path):
    """Velocities in the world that are declared to be the body's."""
    world = seen.rotation.apply(seen.state[:, 6:9])
    columns = {f"v{axis}": world[:, i] for i, axis in enumerate("xyz")}
    write_csv(folder / "world.csv", seen, **columns)
    settings = config.load(ImportSettings, folder / "settings.yaml")
    assert settings.table is not None
    named = replace(settings, table=replace(settings.table, velocity=("vx", "vy", "vz")))
    config.save(named, folder / "body.yaml")
    argv = (*arguments(folder, tmp_path / "drives", "world.csv", "body.yaml"), "--map")
    message = refusal(door("import_drives"), *argv, folder / "level.npz")
    assert "world.csv: velocity: expected to point where the positions go, found" in message
    config.save(replace(named, frames=Frames(velocity="world")), folder / "body.yaml")
    run(*argv, folder / "level.npz")
    drives, _ = dataset.load_drives(tmp_path / "drives", "train")
    at = seen.time[0] + 0.1 * np.arange(drives.length[0] + 1)
    error = errors(np.asarray(drives.state[0])[: len(at)], at)
    assert np.abs(error[:, 6:9]).max() < 0.03


def test_refusals_are_one_line_and_leave_nothing(folder, seen, tmp_path):
    output, with_map = tmp_path / "drives", ("--map", folder / "level.npz")

    def message(*argv):
        text = refusal(door("import_drives"), *argv)
        assert not output.exists() and not list(tmp_path.glob(".*"))
        return text

    assert "--map MAP.npz" in message(*arguments(folder, output))
    assert "none.csv: expected a file or folder" in message(*arguments(folder, output, "none.csv"))
    assert "expected a name that ends in one of .csv" in message(
        *arguments(folder, output, "level.npz"), *with_map
    )
    assert "no such file" in message(*arguments(folder, output, settings="none.yaml"), *with_map)
    assert "none.npz: file: expected" in message(
        *arguments(folder, output), "--map", folder / "none.npz"
    )
    assert "expected the .npz map of one world" in message(
        *arguments(folder, output), "--map", folder
    )
    (folder / "bad.yaml").write_text("vehicle: {wheelbase: 2.0}\n")
    bad = message(*arguments(folder, output, settings="bad.yaml"), *with_map)
    assert "bad.yaml: vehicle.track: missing, expected float" in bad
    write_csv(folder / "swapped.csv", seen, t=seen.time[::-1])
    swapped = message(*arguments(folder, output, "swapped.csv"), *with_map)
    assert "swapped.csv: time: expected stamps that increase" in swapped
    write_csv(folder / "degrees.csv", seen, steer=np.degrees(seen.command[:, 1]))
    degrees = message(*arguments(folder, output, "degrees.csv"), *with_map)
    assert "degrees.csv: control: expected finite front-wheel angle in rad" in degrees
    few = {name: getattr(seen, name)[:40] for name in ("time", "position", "command", "rotation")}
    write_csv(folder / "few.csv", replace(seen, **few))
    short = message(*arguments(folder, output, "few.csv"), *with_map)
    assert short.endswith("found none: 1 shorter than 20 steps")
    with pytest.raises(SystemExit) as stop:
        run("--output", output, "--settings", folder / "settings.yaml")
    assert stop.value.code == 2
    output.mkdir()
    assert "expected no such folder yet" in refusal(
        door("import_drives"), *arguments(folder, output), *with_map
    )


def test_stopping_leaves_nothing(folder, tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(schema, "write", stop)
    with pytest.raises(SystemExit) as stopped:
        run(*arguments(folder, tmp_path / "drives"), "--map", folder / "level.npz")
    assert stopped.value.code == 130 and not list(tmp_path.iterdir())
