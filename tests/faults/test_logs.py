"""Of logs, what is usable is used, and what is not is left out and said, or refused."""

import csv
import re
from dataclasses import replace

import numpy as np
import pytest
from doors import door, refusal
from importers.bags import Bag
from importers.logged import SETTINGS, logged, terrain
from rosbags.rosbag2 import StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from vertiwm_jax import config
from vertiwm_jax.importers import commands
from vertiwm_jax.importers.settings import Resampling, Table, Topics
from vertiwm_jax.learning import dataset
from vertiwm_jax.terrain import files

SECONDS, SHORTEST = 6, 20
QUATERNION = ("qx", "qy", "qz", "qw")
TABLE = Table("t", ("x", "y", "z"), "speed", "steer", quaternion=QUATERNION)


@pytest.fixture(scope="module")
def seen():
    return logged(seconds=SECONDS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The ground of all logs."""
    folder = tmp_path_factory.mktemp("ground")
    files.save(terrain(), folder / "level.npz")
    return folder


def columns(seen):
    rotation = seen.rotation.as_quat()
    return {
        "t": seen.time,
        **{axis: seen.position[:, i] for i, axis in enumerate("xyz")},
        **{name: rotation[:, i] for i, name in enumerate(QUATERNION)},
        "speed": seen.command[:, 0],
        "steer": seen.command[:, 1],
    }


def text(drives):
    """A CSV file of drives by their names, each with its columns."""
    lines = [["drive", *next(iter(drives.values()))]]
    for name, found in drives.items():
        lines += [[name, *(f"{x:.9f}" for x in row)] for row in zip(*found.values(), strict=True)]
    return "".join(",".join(line) + "\n" for line in lines)


def arguments(folder, source, output, settings=None):
    found = replace(
        SETTINGS, table=replace(TABLE, drive="drive"), resampling=Resampling(shortest=SHORTEST)
    )
    config.save(settings or found, output.with_suffix(".yaml"))
    given = {
        "--output": output,
        "--settings": output.with_suffix(".yaml"),
        "--map": folder / "level.npz",
    }
    return [str(source), *(str(word) for pair in given.items() for word in pair)]


def imported(folder, source, output, settings=None):
    """The states of the drives that the command makes of a log."""
    door("import_drives")(arguments(folder, source, output, settings))
    return np.asarray(dataset.load_drives(output, "train")[0].state)


def left_out(said):
    """The cell of the table that tells what was left out."""
    return re.findall(r"\| ([^|]*?) *\|\n\n", said)[0]


@pytest.mark.parametrize("ending", ["\n", "\n\n \n"])
def test_blank_lines_are_passed_over(folder, seen, tmp_path, ending):
    whole = text({"dawn": columns(seen), "dusk": columns(seen)})
    (tmp_path / "whole.csv").write_text(whole)
    (tmp_path / "blank.csv").write_text(whole.replace("\ndusk", "\n\ndusk", 1) + ending)
    expected = imported(folder, tmp_path / "whole.csv", tmp_path / "expected")
    found = imported(folder, tmp_path / "blank.csv", tmp_path / "found")
    np.testing.assert_array_equal(found, expected)


def test_a_drive_of_one_pose_is_left_out(folder, seen, tmp_path, capsys):
    one = {name: column[:1] for name, column in columns(seen).items()}
    log = tmp_path / "log.csv"
    log.write_text(text({"dawn": columns(seen), "noon": one, "dusk": columns(seen)}))
    assert len(imported(folder, log, tmp_path / "drives")) == 2
    assert left_out(capsys.readouterr().out) == f"1 shorter than {SHORTEST} steps"


def with_value(name, value):
    def damaged(row):
        row[name] = value
        return row

    return damaged


def standing_still(row):
    """The attitude that a driver tells before its filter has begun."""
    return row | dict.fromkeys(QUATERNION, "0")


BAD_ROWS = {
    "nan": with_value("x", "nan"),
    "empty": with_value("x", ""),
    "word": with_value("speed", "-"),
    "no attitude": standing_still,
    "earlier": with_value("t", "100.5"),
}


@pytest.mark.parametrize("case", BAD_ROWS)
def test_a_bad_row_is_left_out_and_said(folder, seen, tmp_path, capsys, case):
    whole = text({"dawn": columns(seen), "dusk": columns(seen)})
    rows = list(csv.DictReader(whole.splitlines()))
    place = 3 * len(rows) // 4
    time = int(float(rows[place]["t"]))
    rows[place] = BAD_ROWS[case](rows[place])
    log = tmp_path / "log.csv"
    with log.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    (tmp_path / "whole.csv").write_text(whole)
    expected = imported(folder, tmp_path / "whole.csv", tmp_path / "expected")
    capsys.readouterr()
    found = imported(folder, log, tmp_path / "drives")
    np.testing.assert_array_equal(found[0], expected[0])
    said = capsys.readouterr().out
    assert str(log) in said and "dusk" in said and str(time) in said


def test_a_last_line_that_is_cut_off_is_left_out_and_said(folder, seen, tmp_path, capsys):
    log = tmp_path / "log.csv"
    log.write_text(text({"dawn": columns(seen)})[:-40])
    assert len(imported(folder, log, tmp_path / "drives")) == 1
    assert left_out(capsys.readouterr().out) != "-"


def ahead():
    """The columns of a drive that goes where it looks, which `logged` does not."""
    time = np.arange(0, 12, 0.05)
    yaw = 0.4 + 0.5 * np.sin(0.5 * time)
    step = 2.5 * 0.05 * np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], 1)
    position = np.cumsum(step, axis=0) - [12, 8, 0]
    roll, pitch = 0.1 * np.sin(0.7 * time), 0.08 * np.cos(0.9 * time)
    rotation = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], 1)).as_quat()
    return {
        "t": time,
        **{axis: position[:, i] for i, axis in enumerate("xyz")},
        **{name: rotation[:, i] for i, name in enumerate(QUATERNION)},
        "roll": roll,
        "pitch": pitch,
        "yaw": yaw,
        "compass": np.pi / 2 - yaw,
        "speed": np.full(len(time), 2.5),
        "steer": np.arctan(2.0 / 2.5 * 0.25 * np.cos(0.5 * time)),
    }


RPY = replace(TABLE, rpy=("roll", "pitch", "yaw"), quaternion=None)


def of_attitudes(table):
    return replace(SETTINGS, table=table, resampling=Resampling(shortest=SHORTEST))


@pytest.mark.parametrize("table", [TABLE, RPY], ids=["quaternion", "rpy"])
def test_attitudes_that_agree_with_the_motion_are_read(folder, tmp_path, table):
    (tmp_path / "log.csv").write_text(text({"dawn": ahead()}))
    found = imported(folder, tmp_path / "log.csv", tmp_path / "drives", of_attitudes(table))
    assert np.abs(found[0, :, 7]).max() < 0.1 < 2 < found[0, :, 6].min()


def in_degrees(made):
    return {
        name: np.degrees(x) if name in ("roll", "pitch", "yaw") else x for name, x in made.items()
    }


WRONG_ATTITUDES = {
    "degrees": (RPY, in_degrees),
    "compass": (replace(RPY, rpy=("roll", "pitch", "compass")), dict),
    "w first": (replace(TABLE, quaternion=("qw", "qx", "qy", "qz")), dict),
}


@pytest.mark.parametrize("case", WRONG_ATTITUDES)
def test_attitudes_of_another_unit_or_frame_are_refused(folder, tmp_path, case):
    table, changed = WRONG_ATTITUDES[case]
    (tmp_path / "log.csv").write_text(text({"dawn": changed(ahead())}))
    argv = arguments(folder, tmp_path / "log.csv", tmp_path / "drives", of_attitudes(table))
    assert str(tmp_path / "log.csv") in refusal(door("import_drives"), *argv)


@pytest.mark.parametrize("speed", [0.001, -0.001])
def test_a_vehicle_that_hardly_moves_does_not_tell_its_steering(speed):
    angles = commands.steering(np.array([2.0, speed]), np.array([0.5, 0.5]), wheelbase=2.0)
    assert np.abs(angles).max() < 0.8  # No car steers farther.


class Stored(Bag):
    """A bag of ROS 2 in a store of one's choice."""

    def __init__(self, path, store):
        super().__init__(path)
        self._writer = Writer(path, version=9, storage_plugin=store)


@pytest.mark.parametrize("store", StoragePlugin, ids=lambda store: store.name.lower())
def test_the_file_of_a_bag_is_known_by_its_name(folder, seen, tmp_path, store):
    with Stored(tmp_path / "bag", store) as bag:
        bag.odometry(seen)
        bag.ackermann(seen.time, seen.command)
    (file,) = (path for path in (tmp_path / "bag").iterdir() if path.suffix in (".db3", ".mcap"))
    settings = replace(SETTINGS, rosbag=Topics("/odom", "/cmd"))
    expected = imported(folder, tmp_path / "bag", tmp_path / "expected", settings)
    np.testing.assert_array_equal(imported(folder, file, tmp_path / "drives", settings), expected)
