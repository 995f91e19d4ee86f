"""CSV and Parquet, a row a moment."""

import csv
import sys
from dataclasses import replace

import numpy as np
import pyarrow
import pytest
from importers.logged import SETTINGS, VEHICLE, logged
from pyarrow import parquet

from vertiwm_jax import config
from vertiwm_jax.errors import UserError
from vertiwm_jax.importers import table
from vertiwm_jax.importers.settings import ImportSettings, Table, Units
from vertiwm_jax.learning.schema import DataError

NAMES = ["t", "x", "y", "z", "roll", "pitch", "yaw", "speed", "steer"]
TABLE = Table("t", ("x", "y", "z"), "speed", "steer", rpy=("roll", "pitch", "yaw"))
CSV = replace(SETTINGS, table=TABLE)


@pytest.fixture
def seen():
    return logged(seconds=4)


def rows(seen):
    values = np.column_stack([seen.time, seen.state[:, :6], seen.command])
    return [[f"{value:.9f}" for value in row] for row in values]


def write(path, head, lines):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([head, *lines])
    return path


def test_a_csv_file_is_a_drive(seen, tmp_path):
    lines = [[*row, "left alone"] for row in rows(seen)]
    (log,) = table.read(write(tmp_path / "a.csv", [*NAMES, "note"], lines), CSV)
    np.testing.assert_allclose(log.time, seen.time, atol=1e-9)
    np.testing.assert_allclose(log.position, seen.state[:, :3], atol=1e-9)
    assert (log.rotation.inv() * seen.rotation).magnitude().max() < 1e-8
    np.testing.assert_allclose(log.command, seen.command, atol=1e-9)
    np.testing.assert_array_equal(log.command_time, log.time)
    assert log.velocity is None and log.angular_velocity is None


def nedm(seen, episodes):
    """The columns of NeDM's vehicle that are read, in its types, and some that are not."""
    w_first = seen.rotation.as_quat()[:, [3, 0, 1, 2]]
    groups = {
        "pos_{}_m": seen.state[:, :3],
        "vel_body_{}_mps": seen.state[:, 6:9],
        "ang_vel_body_{}_radps": seen.state[:, 9:12],
        "acc_world_{}_mps2": np.zeros((len(seen.time), 3)),
    }
    columns = {
        key.format(axis): values[:, i].astype(np.float32)
        for key, values in groups.items()
        for i, axis in enumerate("xyz")
    }
    columns |= {f"quat_e{i}": w_first[:, i].astype(np.float32) for i in range(4)}
    columns |= {
        "driver_steering": np.full(len(seen.time), 0.5, np.float32),
        "driver_throttle": np.full(len(seen.time), 0.4, np.float32),
        "driver_braking": np.full(len(seen.time), 0.1, np.float32),
        "sample_index": np.arange(len(seen.time), dtype=np.int32),
        "time_s": seen.time - seen.time[0] + 2.5,
    }
    joined = {key: np.tile(column, len(episodes)) for key, column in columns.items()}
    names = pyarrow.array(np.repeat(episodes, len(seen.time))).dictionary_encode()
    return pyarrow.table({"episode_id": names, **joined})


def test_parquet_of_nedm(seen, tmp_path):
    settings = config.load(ImportSettings, config.default_config("import_nedm"))
    path = tmp_path / "shard_000.parquet"
    parquet.write_table(nedm(seen, ["episode_7", "episode_3"]), path, compression="zstd")
    logs = table.read(path, settings)
    assert len(logs) == 2
    for log in logs:
        np.testing.assert_allclose(log.time, seen.time - seen.time[0] + 2.5)
        np.testing.assert_allclose(log.position, seen.state[:, :3], atol=2e-6)
        assert (log.rotation.inv() * seen.rotation).magnitude().max() < 1e-6
        np.testing.assert_allclose(log.velocity, seen.state[:, 6:9], atol=1e-6)
        np.testing.assert_allclose(log.angular_velocity, seen.state[:, 9:12], atol=1e-6)
        np.testing.assert_allclose(log.command, [[3.0, 0.5 * 0.3725]] * len(log.time), rtol=1e-6)


@pytest.mark.parametrize("separator", [";", "\t"])
def test_other_separators(seen, tmp_path, separator):
    path = write(tmp_path / "a.csv", NAMES, rows(seen))
    (expected,) = table.read(path, CSV)
    path.write_text(path.read_text().replace(",", separator))
    (log,) = table.read(path, CSV)
    np.testing.assert_array_equal(log.position, expected.position)


@pytest.mark.parametrize("unit", ["ms", "ns"])
def test_dates_have_units_of_their_own(seen, tmp_path, unit):
    columns = dict(zip(NAMES, np.array(rows(seen), float).T, strict=True))
    stamps = (1e3 * columns["t"]).round().astype("datetime64[ms]").astype(f"datetime64[{unit}]")
    stamps[3] = np.datetime64("NaT", unit)
    path = tmp_path / "a.parquet"
    parquet.write_table(pyarrow.table(columns | {"t": stamps}), path)
    (log,) = table.read(path, replace(CSV, units=Units(time=1e-3)))
    np.testing.assert_allclose(log.time, np.delete(seen.time, 3), atol=1e-3)


def test_drives_come_in_the_order_in_which_they_begin(seen, tmp_path):
    lines = [[*row, name] for name in ("late", "early") for row in rows(seen)]
    lines[0][0] = "99.5"
    settings = replace(CSV, table=replace(TABLE, drive="run"))
    logs = table.read(write(tmp_path / "a.csv", [*NAMES, "run"], lines), settings)
    assert [log.time[0] for log in logs] == [99.5, pytest.approx(seen.time[0])]


def test_drives_that_cannot_be_used_are_left_out_and_said(seen, tmp_path):
    drives = {name: [[*row, name] for row in rows(seen)] for name in ("dawn", "noon", "dusk")}
    settings, path = replace(CSV, table=replace(TABLE, drive="run")), tmp_path / "a.csv"

    def with_wrong(*names):
        for name in names:
            for line in drives[name]:
                line[1] = "nan"
        return write(path, [*NAMES, "run"], [line for lines in drives.values() for line in lines])

    dawn, dusk = table.read(with_wrong("noon"), settings)
    assert [dawn.name, dusk.name] == [f"{path}: drive dawn", f"{path}: drive dusk"]
    (remark,) = dawn.remarks
    assert remark.startswith(f"{path}: drive noon: position: expected finite numbers")
    assert dawn.remarks[remark] == len(seen.time) and not dusk.remarks
    with pytest.raises(DataError, match="drive dusk: position: expected finite numbers"):
        table.read(with_wrong("dusk"), settings)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda line: line[:4], "line 7: expected 9 values as in the head, found 4: left out 1 "),
        (lambda line: [*line, "5"], "line 7: expected 9 values as in the head, found 10: left out"),
        (lambda line: ["north", *line[1:]], "time: expected finite numbers, found nan"),
        (lambda line: [*line[:3], "", *line[4:]], "position: expected finite numbers, found ["),
    ],
)
def test_a_bad_line_is_left_out_and_said(seen, tmp_path, damage, said):
    lines = rows(seen)
    lines[5] = damage(lines[5])
    (log,) = table.read(write(tmp_path / "a.csv", NAMES, lines), CSV)
    np.testing.assert_allclose(log.time, np.delete(seen.time, 5), atol=1e-6)
    remark, *_ = log.remarks  # A row without a time is neither a pose nor a command.
    assert remark.startswith(f"{tmp_path / 'a.csv'}: {said}")


def test_files_that_cannot_be_read_are_named(seen, tmp_path):
    path, lines = tmp_path / "a.csv", rows(seen)

    def message(settings=CSV):
        with pytest.raises(DataError) as error:
            table.read(path, settings)
        assert "\n" not in str(error.value)
        return str(error.value).removeprefix(f"{path}: ")

    write(path, NAMES[:-1], lines)
    assert message() == f"expected columns steer, found only {', '.join(NAMES[:-1])}"
    write(path, NAMES, [[*line, "5"] for line in lines])  # such as of a comma within a number
    assert message().startswith("line 2: expected 9 values as in the head, found 10; ")
    write(path, NAMES, [["north", *line[1:]] for line in lines])
    assert message().startswith("t: expected numbers: could not convert string to float")
    write(path, NAMES, [[*line[:3], "nan", *line[4:]] for line in lines])
    assert message().startswith("position: expected finite numbers, found [")
    write(path, NAMES, [])
    assert message() == "expected rows below the head, found none"
    path.write_bytes(b"t,x\xff\n")
    assert message().startswith("expected a CSV file in UTF-8")
    assert message(settings=ImportSettings(VEHICLE)).startswith("expected settings with a section")
    path = tmp_path / "a.parquet"
    path.write_bytes(b"t,x")
    assert message().startswith("expected a Parquet file")
    parquet.write_table(pyarrow.table({"t": [1.0]}), path)
    assert message().startswith("expected columns x, y, z, ")


def test_attitudes_are_told_once():
    for attitudes in ({}, {"rpy": ("a", "b", "c"), "quaternion": ("a", "b", "c", "d")}):
        with pytest.raises(ValueError, match="rpy, quaternion, yaw: expected one of"):
            Table("t", ("x", "y", "z"), "speed", "steer", **attitudes)


def test_parquet_needs_a_package(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(UserError, match=r'package pyarrow.* pip install "vertiwm-jax\[logs\]"'):
        table.read(tmp_path / "a.parquet", CSV)
