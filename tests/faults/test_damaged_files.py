"""Whatever a file holds, its reader gives what is in it or ends in its own error of one line."""

import io
import json
import struct
from dataclasses import replace

import numpy as np
import pyarrow
import pytest
from faults.border import refusal
from importers.bags import Bag
from importers.logged import SETTINGS, logged
from PIL import Image
from pyarrow import parquet

from vertiwm_jax.importers import rosbag, table
from vertiwm_jax.importers.settings import Table, Topics
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.terrain import files, vertibench
from vertiwm_jax.terrain.map import MapError, TerrainMap

GRASS = 3
BAG = replace(SETTINGS, rosbag=Topics("/odom", "/cmd"))
TABLE = replace(
    SETTINGS,
    table=Table("t", ("x", "y", "z"), "speed", "steer", quaternion=("qx", "qy", "qz", "qw")),
)
FLIPPED = 0x55


@pytest.fixture
def good(tmp_path):
    """A map that can be read."""
    heights = 5 + np.random.default_rng(0).random((21, 21))
    files.save(TerrainMap.from_array(heights, np.full((4, 4), GRASS)), tmp_path / "map.npz")
    files.load_map(tmp_path / "map.npz")
    return tmp_path / "map.npz"


def array(values):
    """What `numpy.save` writes."""
    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()


def renamed(whole):
    return array(np.zeros(3))


def damaged_in_the_middle(whole):
    """The first array begins with a block of a kind that there is none of."""
    (name_length, extra_length), data = struct.unpack("<HH", whole[26:30]), bytearray(whole)
    first = 30 + name_length + extra_length
    data[first : first + 8] = b"\xff" * 8
    return bytes(data)


def in_the_directory(whole, offset, value):
    """With a 16-bit number of the first entry of the archive's directory replaced."""
    data, entry = bytearray(whole), whole.index(b"PK\x01\x02")
    struct.pack_into("<H", data, entry + offset, value)
    return bytes(data)


def of_unknown_compression(whole):
    return in_the_directory(whole, 10, 99)


def encrypted(whole):
    return in_the_directory(whole, 8, 1)


def of_a_later_version(whole):
    return in_the_directory(whole, 6, 120)


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: b"",
        renamed,
        damaged_in_the_middle,
        of_unknown_compression,
        encrypted,
        of_a_later_version,
    ],
    ids=["empty", "renamed", "damaged", "unknown compression", "encrypted", "later version"],
)
def test_a_damaged_map_is_refused(good, damage):
    good.write_bytes(damage(good.read_bytes()))
    message = refusal(lambda: files.load_map(good), MapError)
    assert message.startswith(f"{good}: file: expected an .npz map")


def test_a_byte_anywhere_in_a_map_may_be_wrong(good):
    whole = good.read_bytes()
    for place in range(0, len(whole), 13):
        data = bytearray(whole)
        data[place] ^= FLIPPED
        good.write_bytes(data)
        refusal(lambda: files.load_map(good), MapError)


def test_a_map_may_be_cut_off_anywhere(good):
    whole = good.read_bytes()
    for length in range(1, len(whole), 37):
        good.write_bytes(whole[:length])
        assert "file: expected an .npz map" in refusal(lambda: files.load_map(good), MapError)


@pytest.mark.parametrize("name", ["elevation", "patch_class", "obstacles", "origin", "meta"])
def test_a_map_may_have_other_names(good, name):
    arrays = dict(np.load(good))
    np.savez(good, **{f"the_{key}" if key == name else key: x for key, x in arrays.items()})
    message = refusal(lambda: files.load_map(good), MapError)
    assert message.startswith(f"{good}: file: expected") and f"{name} is not a file" in message


def meta(whole, **changes):
    return json.dumps(json.loads(str(whole["meta"])) | changes)


OF_ANOTHER_TYPE = {
    "heights in words": ("elevation", lambda whole: np.full((21, 21), "high")),
    "friction in words": ("patch_friction", lambda whole: np.full((4, 4), "high")),
    "colours in words": ("class_rgb", lambda whole: np.full((10, 3), "red")),
    "resolution in words": ("resolution", lambda whole: np.array("fine")),
    "origin in words": ("origin", lambda whole: np.array(["west", "north"])),
    "a list": ("meta", lambda whole: "[]"),
    "a number": ("meta", lambda whole: "3"),
    "no classes": ("meta", lambda whole: meta(whole, classes=3)),
    "classes by number": ("meta", lambda whole: meta(whole, classes=list(range(10)))),
    "a list of soils": ("meta", lambda whole: meta(whole, soils=[])),
    "a number as soil": ("meta", lambda whole: meta(whole, soils={"mud": 3})),
    "a soil in words": ("meta", lambda whole: meta(whole, soils={"mud": ["soft"] * 7})),
    "no fields": ("meta", lambda whole: meta(whole, soil_fields=3)),
}


@pytest.mark.parametrize("case", OF_ANOTHER_TYPE)
def test_what_a_map_holds_may_be_of_another_type(good, case):
    name, changed = OF_ANOTHER_TYPE[case]
    arrays = dict(np.load(good))
    np.savez(good, **arrays | {name: changed(arrays)})
    message = refusal(lambda: files.load_map(good), MapError)
    assert message.startswith(f"{good}: ")


def tagged_without_width():
    stream = io.BytesIO()
    Image.fromarray(np.ones((21, 21), np.float32)).save(stream, "TIFF")
    width, none = (struct.pack("<HHLL", 256, 4, 1, size) for size in (21, 0))
    assert stream.getvalue().count(width) == 1
    return stream.getvalue().replace(width, none)


HEIGHTS = {
    "empty.npy": b"",
    "header.npy": array(np.ones((21, 21))).replace(b"}", b" ", 1),
    "cut.tif": b"II*\0\x08\0\0",
    "thin.tif": tagged_without_width(),
}


@pytest.mark.parametrize("name", HEIGHTS)
def test_damaged_heights_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(HEIGHTS[name])
    message = refusal(lambda: files.from_heightmap(tmp_path / name, 1.0), MapError)
    assert message.startswith(f"{tmp_path / name}: elevation: expected")


def test_damaged_classes_are_refused(tmp_path):
    np.save(tmp_path / "heights.npy", np.ones((21, 21)))
    classes = tmp_path / "classes.npy"
    classes.touch()
    message = refusal(
        lambda: files.from_heightmap(tmp_path / "heights.npy", 1.0, class_image=classes), MapError
    )
    assert message.startswith(f"{classes}: class_image: expected")


def test_a_checkout_without_worlds_is_refused(tmp_path):
    (tmp_path / "envs/data/BenchMaps/sampled_maps").mkdir(parents=True)
    assert str(tmp_path) in refusal(lambda: vertibench.load(tmp_path), MapError)


@pytest.fixture(scope="module")
def seen():
    return logged(seconds=1)


def anywhere_wrong(path, read, places):
    """Reads the file with one byte wrong, and cut off, at this many places each."""
    whole = path.read_bytes()
    assert not refusal(read, DataError)
    for place in np.linspace(0, len(whole) - 1, places).astype(int):
        wrong = bytearray(whole)
        wrong[place] ^= FLIPPED
        for data in (wrong, whole[:place]):
            path.write_bytes(data)
            refusal(read, DataError)


@pytest.mark.parametrize("name", ["drive.bag", "drive"])
def test_a_byte_anywhere_in_a_bag_may_be_wrong(seen, tmp_path, name):
    with Bag(tmp_path / name) as bag:
        bag.odometry(seen)
        bag.ackermann(seen.time, seen.command)
    (path,) = [tmp_path / name] if name.endswith("bag") else (tmp_path / name).glob("*.db3")
    anywhere_wrong(path, lambda: rosbag.read(tmp_path / name, BAG), 120)


def test_a_byte_anywhere_in_the_notes_of_a_bag_may_be_wrong(seen, tmp_path):
    with Bag(tmp_path / "drive") as bag:
        bag.odometry(seen)
        bag.ackermann(seen.time, seen.command)
    notes = tmp_path / "drive" / "metadata.yaml"
    anywhere_wrong(notes, lambda: rosbag.read(tmp_path / "drive", BAG), 120)


def test_a_byte_anywhere_in_parquet_may_be_wrong(seen, tmp_path):
    rotation = seen.rotation.as_quat()
    columns = {
        "t": seen.time,
        **{axis: seen.position[:, i] for i, axis in enumerate("xyz")},
        **{f"q{axis}": rotation[:, i] for i, axis in enumerate("xyzw")},
        "speed": seen.command[:, 0],
        "steer": seen.command[:, 1],
    }
    path = tmp_path / "drive.parquet"
    parquet.write_table(pyarrow.table(columns), path)
    anywhere_wrong(path, lambda: table.read(path, TABLE), 200)
