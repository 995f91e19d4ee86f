"""Files and folders that are written as a whole, or not at all."""

import os
from pathlib import Path

import pytest
from disks import full_disk

from vertiwm_jax import atomic
from vertiwm_jax.atomic import WriteError


def test_a_file_is_replaced(tmp_path):
    path = tmp_path / "table.txt"
    atomic.write(path, "grün")
    atomic.write(path, "blau")
    assert path.read_text(encoding="utf-8") == "blau"
    atomic.write(path, b"\x00\x01")
    assert path.read_bytes() == b"\x00\x01"
    assert os.listdir(tmp_path) == ["table.txt"]


def test_a_new_folder_is_whole_or_not_there(tmp_path):
    with pytest.raises(KeyboardInterrupt), atomic.new_folder(tmp_path / "made") as unfinished:
        (unfinished / "first").touch()
        raise KeyboardInterrupt
    assert os.listdir(tmp_path) == []
    with atomic.new_folder(tmp_path / "made") as unfinished:
        (unfinished / "first").touch()
    assert os.listdir(tmp_path) == ["made"] and os.listdir(tmp_path / "made") == ["first"]
    with (
        pytest.raises(WriteError, match="expected no such folder"),
        atomic.new_folder(tmp_path / "made"),
    ):
        raise AssertionError
    with pytest.raises(WriteError, match="first/made: cannot make"):
        atomic.new_folder(tmp_path / "made" / "first" / "made").__enter__()


def test_a_full_disk_leaves_the_old_file(tmp_path):
    path = tmp_path / "plot.png"
    atomic.write(path, b"old")
    with full_disk(after=1000), pytest.raises(WriteError, match=r"plot\.png: cannot write"):
        atomic.write(path, b"x" * 5000)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["plot.png"]
    with pytest.raises(WriteError, match="No such file"):
        atomic.write(tmp_path / "absent" / "plot.png", b"x")


@pytest.mark.parametrize("moment", [(os, "fsync"), (Path, "replace")])
def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch, moment):
    path = tmp_path / "plot.png"
    atomic.write(path, b"old")

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(*moment, interrupt)
    with pytest.raises(KeyboardInterrupt):
        atomic.write(path, b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["plot.png"]
