"""Whatever is wrong with a file, each reader of maps gives a sound map or its error of one line."""

import io
import json
import math
import shutil
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
import rasterio
import yaml
from faults.border import outcome
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from terrain.test_vertibench import write_world

from vertiwm_jax.terrain import files, vertibench
from vertiwm_jax.terrain.classes import STANDARD
from vertiwm_jax.terrain.map import MapError, TerrainMap

pytestmark = pytest.mark.slow
EXAMPLES = 300
GRASS = 3
HEIGHTS = np.round(5 + np.random.default_rng(0).random((21, 21)), 2).astype(np.float32)
IDS = np.arange(36, dtype=np.uint8).reshape(6, 6) % 10
ENDS = 600
"""Bytes at both ends of a file, where most say what the others are."""

places = st.floats(0, 1, exclude_max=True)
near_an_end = st.integers(-ENDS, ENDS - 1)


@st.composite
def damaged(draw, whole):
    """The bytes with some flipped, left out, put in or exchanged, or cut off."""
    data = bytearray(whole)

    def place():
        at = draw(st.one_of(places.map(lambda x: int(x * len(data))), near_an_end))
        return at % max(len(data), 1)

    for kind in draw(st.lists(st.sampled_from(["flip", "cut", "drop", "put", "swap"]), min_size=1)):
        at, span = place(), draw(st.integers(1, 40))
        if kind == "flip" and data:
            data[at] ^= draw(st.integers(1, 255))
        elif kind == "cut":
            del data[at:]
        elif kind == "drop":
            del data[at : at + span]
        elif kind == "put":
            data[at:at] = draw(st.binary(min_size=1, max_size=8))
        elif kind == "swap":
            other = place()
            data[at : at + span] = bytes(data[other : other + span])
    return bytes(data)


def sound(terrain):
    assert np.isfinite(terrain.elevation).all() and np.isfinite(terrain.friction).all()
    assert np.isfinite(terrain.obstacles).all() and np.isfinite(terrain.origin).all()
    assert 0 < terrain.resolution < math.inf
    assert (np.asarray(terrain.semantic) < len(terrain.class_names)).all()


def withstands(read, drawn, write):
    """Whether files that are drawn are read as they should be; how many of them were refused."""
    refused = [0, 0]

    @settings(max_examples=EXAMPLES, deadline=None, database=None, derandomize=True)
    @given(drawn)
    def fuzz(content):
        write(content)
        with warnings.catch_warnings(action="error"):
            terrain, message = outcome(read, MapError)
        refused[terrain is None] += 1
        if terrain is None:
            assert message
        else:
            sound(terrain)

    fuzz()
    assert sum(refused) >= 200 and refused[1] > 0
    return refused


def map_file(folder, **changes):
    path = folder / "map.npz"
    boxes = np.array([[1, 2, 1, 2, 3]])
    files.save(TerrainMap.from_array(HEIGHTS, IDS, obstacles=boxes), path)
    arrays = {**dict(np.load(path)), **changes}
    np.savez(path, **{key: x for key, x in arrays.items() if x is not None})
    return path


@pytest.mark.parametrize("compressed", [True, False])
def test_bytes_of_a_map(tmp_path, compressed):
    path = map_file(tmp_path)
    if compressed:
        np.savez_compressed(path, **dict(np.load(path)))
    withstands(lambda: files.load_map(path), damaged(path.read_bytes()), path.write_bytes)


numbers = st.one_of(
    st.floats(width=64), st.integers(-(2**31), 2**31), st.sampled_from([0, -1, 256, 1e9, 1e39])
)
arrays = st.one_of(
    st.none(),
    st.builds(
        lambda shape, value, kind: np.full(shape, value).astype(kind),
        st.lists(st.integers(0, 22), max_size=3).map(tuple),
        numbers,
        st.sampled_from(["f2", "f4", "f8", "i4", "u1", "i8", "c8", "?", "U9", "S9", "M8[s]"]),
    ),
)
json_values = st.recursive(
    st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=5)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(), inner)),
    max_leaves=5,
)


@st.composite
def edited(draw, tree):
    """A tree of JSON with one of its values replaced, left out or renamed."""
    keys = list(tree) if isinstance(tree, dict) else list(range(len(tree)))
    if not keys:
        return draw(json_values)
    copy, key = json.loads(json.dumps(tree)), draw(st.sampled_from(keys))
    inner = copy[key]
    if isinstance(inner, dict | list) and draw(st.integers(0, 3)):
        copy[key] = draw(edited(inner))
    elif draw(st.booleans()):
        copy[key] = draw(json_values)
    else:
        del copy[key]
    return copy


@st.composite
def another_map(draw, whole):
    """Arrays of which some are of another type, shape or value, or are those of another name."""
    found = dict(whole)
    for name in draw(st.lists(st.sampled_from(sorted(whole)), min_size=1, max_size=2)):
        kind = draw(st.sampled_from(["array", "entry", "swap", "meta"]))
        if kind == "array":
            found[name] = draw(arrays)
        elif kind == "swap":
            other = draw(st.sampled_from(sorted(whole)))
            found[name], found[other] = whole[other], whole[name]
        elif kind == "meta":
            meta = draw(edited(json.loads(str(whole["meta"]))))
            found["meta"] = np.array(json.dumps(meta))
        elif whole[name].dtype.kind in "fiu":
            array = whole[name].astype(draw(st.sampled_from(["f4", "f8", "i8"])))
            entry = draw(st.integers(0, array.size - 1))
            with np.errstate(all="ignore"):
                array.flat[entry] = np.float64(draw(numbers)).astype(array.dtype)
            found[name] = array
    return found


def test_fields_of_a_map(tmp_path):
    path = map_file(tmp_path)
    drawn = another_map(dict(np.load(path)))
    refused = withstands(
        lambda: files.load_map(path), drawn, lambda found: map_file(tmp_path, **found)
    )
    assert refused[0] > 5


def npy_of(values):
    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()


def png_of(values):
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, "PNG")
    return stream.getvalue()


def tiff_of(values, **profile):
    with rasterio.MemoryFile() as memory:
        rows, columns = values.shape
        profile = {"width": columns, "height": rows, "count": 1, "dtype": values.dtype} | profile
        transform = rasterio.Affine(1, 0, 500000, 0, -1, 5000000)
        with memory.open(driver="GTiff", crs="EPSG:32632", transform=transform, **profile) as file:
            file.write(values, 1)
        return bytes(memory.read())


GRAY = (HEIGHTS * 5000).astype(np.uint16)
HEIGHT_FILES = {
    "a.npy": (npy_of(HEIGHTS), {}),
    "a.png": (png_of(GRAY), {"height_range": (0.0, 9.0)}),
    "plain.tif": (tiff_of(HEIGHTS), {}),
    "lzw.tif": (tiff_of(HEIGHTS, compress="lzw", predictor=3), {}),
    "tiled.tif": (
        tiff_of(GRAY // 5000, tiled=True, blockxsize=16, blockysize=16, compress="deflate"), {},
    ),
    "pillow.tif": (None, {}),
}  # fmt: skip


@pytest.mark.parametrize("name", HEIGHT_FILES)
def test_bytes_of_heights(tmp_path, name, capfd):
    path, (whole, options) = tmp_path / name, HEIGHT_FILES[name]
    if whole is None:
        Image.fromarray(HEIGHTS).save(path)
        whole = path.read_bytes()
    withstands(lambda: files.from_heightmap(path, 1.0, **options), damaged(whole), path.write_bytes)
    out, err = capfd.readouterr()
    # What libtiff itself says of places that no file has, GDAL does not catch.
    assert out + err.replace("_tiffSeekProc: Invalid argument.\n", "") == ""


@st.composite
def header(draw):
    """A header of NumPy's that says something else of what follows it."""
    head = {
        "descr": draw(st.sampled_from(["<f4", ">f8", "|u1", "<i8", "|O", "<U4", "<c8", "<M8[s]"])),
        "fortran_order": draw(st.booleans()),
        "shape": draw(st.lists(st.integers(-2, 2**40), max_size=3).map(tuple)),
    }
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, head)
    return stream.getvalue() + HEIGHTS.tobytes()


def test_headers_of_arrays(tmp_path):
    path = tmp_path / "a.npy"
    withstands(lambda: files.from_heightmap(path, 1.0), header(), path.write_bytes)


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@st.composite
def png(draw):
    """Sizes, depths and kinds of color that do not fit the pixels, with the right checksums."""
    side = st.one_of(st.integers(0, 40), st.integers(0, 2**32 - 1))
    one_of = [st.sampled_from([1, 2, 4, 8, 16, 3]), st.integers(0, 7), *[st.integers(0, 2)] * 3]
    head = struct.pack(">IIBBBBB", draw(side), draw(side), *map(draw, one_of))
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in GRAY)
    chunks = [chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]
    if draw(st.booleans()):
        kind = draw(st.sampled_from([b"PLTE", b"tRNS", b"acTL", b"zTXt", b"iCCP", b"gAMA"]))
        chunks.insert(1, chunk(kind, draw(st.binary(max_size=30))))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def test_headers_of_images(tmp_path):
    path = tmp_path / "a.png"
    withstands(
        lambda: files.from_heightmap(path, 1.0, height_range=(0.0, 9.0)), png(), path.write_bytes
    )


@pytest.mark.parametrize("name", ["ids.png", "colors.png", "ids.npy", "ids.tif"])
def test_bytes_of_classes(tmp_path, name):
    whole = {
        "ids.png": lambda: png_of(IDS),
        "colors.png": lambda: png_of(STANDARD.rgb[IDS]),
        "ids.npy": lambda: npy_of(IDS),
        "ids.tif": lambda: tiff_of(IDS),
    }[name]()
    path = tmp_path / name
    np.save(tmp_path / "a.npy", HEIGHTS)
    withstands(
        lambda: files.from_heightmap(tmp_path / "a.npy", 1.0, class_image=path),
        damaged(whole),
        path.write_bytes,
    )


@pytest.fixture(scope="module")
def checkout(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("checkout")
    gray = np.random.default_rng(0).integers(0, 255, (129, 129)).astype(np.uint8)
    write_world(folder, 1, "low", gray, np.full((16, 16), 2))
    return folder


@pytest.mark.parametrize("name", ["Worlds/1.bmp", "Configs/Final/config1_low.yaml"])
def test_bytes_of_a_checkout(tmp_path, checkout, name):
    shutil.copytree(checkout, tmp_path, dirs_exist_ok=True)
    path = tmp_path / vertibench._FOLDER / name
    withstands(lambda: vertibench.load(tmp_path), damaged(path.read_bytes()), path.write_bytes)


def test_fields_of_a_checkout(tmp_path, checkout):
    shutil.copytree(checkout, tmp_path, dirs_exist_ok=True)
    path = tmp_path / vertibench._FOLDER / "Configs/Final/config1_low.yaml"
    whole = yaml.load(path.read_text(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    # JSON is YAML, and written faster.
    withstands(
        lambda: vertibench.load(tmp_path),
        edited(whole),
        lambda config: path.write_text(json.dumps(config)),
    )
