"""How much memory an input asks for is bounded before any is taken."""

import io
import struct
import sys
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest
import rasterio
from faults.border import refusal
from importers.bags import Bag

from vertiwm_jax.importers import grid_map
from vertiwm_jax.importers.settings import Frames, GridMapSettings
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import MapError, TerrainMap

GIB = 2**30
GRASS = 3


@pytest.fixture
def little_memory():
    """4 GiB more than there are in use, so that no fault takes all that the machine has."""
    if not sys.platform.startswith("linux"):
        pytest.skip("only Linux tells and limits what a process asks for")
    import resource

    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + 4 * GIB, hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("away", [(20e3, 20e3), (-2e7, 0.0)])
def test_a_map_that_jumps_is_refused(tmp_path, away):
    heights = {"elevation": np.full((40, 30), 2.0)}
    with Bag(tmp_path / "drive") as bag:
        bag.grid_map(1.0, heights, (0.0, 0.0), 0.1)
        bag.grid_map(2.0, heights, away, 0.1)
    message = refusal(
        lambda: grid_map.terrain([tmp_path / "drive"], GridMapSettings("/map"), Frames()),
        DataError,
    )
    name = f"{tmp_path / 'drive'}: /map"
    assert message.startswith(name)
    assert "20" in message.removeprefix(name)  # km, or thousands of them: the extent.


def claiming(shape):
    """An array of NumPy that says it is larger than it is."""
    stream = io.BytesIO()
    head = {"descr": "<f4", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, head)
    return stream.getvalue() + bytes(64)


def npy(folder):
    (folder / "heights.npy").write_bytes(claiming((10**6, 10**6)))
    return lambda: files.from_heightmap(folder / "heights.npy", 1.0)


def npz(folder):
    files.save(TerrainMap.from_array(np.ones((9, 9)), np.full((2, 2), GRASS)), folder / "good.npz")
    with (
        zipfile.ZipFile(folder / "good.npz") as good,
        zipfile.ZipFile(folder / "map.npz", "w") as bad,
    ):
        for name in good.namelist():
            elevation = name == "elevation.npy"
            bad.writestr(name, claiming((10**6, 10**6)) if elevation else good.read(name))
    return lambda: files.load_map(folder / "map.npz")


def bomb(folder):
    """A gibibyte of zeros in a few megabytes."""
    files.save(TerrainMap.from_array(np.ones((9, 9))), folder / "good.npz")
    options = {"compression": zipfile.ZIP_DEFLATED, "compresslevel": 1}
    with (
        zipfile.ZipFile(folder / "good.npz") as good,
        zipfile.ZipFile(folder / "map.npz", "w", **options) as bad,
    ):
        for name in set(good.namelist()) - {"elevation.npy"}:
            bad.writestr(name, good.read(name))
        with bad.open("elevation.npy", "w", force_zip64=True) as stream:
            stream.write(claiming((2**14, 2**14))[:-64])
            for _ in range(64):
                stream.write(bytes(2**24))
    return lambda: files.load_map(folder / "map.npz")


def tiff(folder):
    transform = rasterio.Affine(1, 0, 500000, 0, -1, 5000000)
    with rasterio.open(
        folder / "heights.tif", "w", driver="GTiff", width=60000, height=60000, count=1,
        dtype="float32", crs="EPSG:32632", transform=transform, sparse_ok=True,
    ):  # fmt: skip
        pass
    return lambda: files.from_heightmap(folder / "heights.tif")


def png(folder):
    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", 60000, 60000, 16, 0, 0, 0, 0)
    (folder / "heights.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", b"") + chunk(b"IEND", b"")
    )
    return lambda: files.from_heightmap(folder / "heights.png", 1.0, height_range=(0, 9))


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("make", [npy, npz, bomb, tiff, png])
def test_a_file_that_says_it_is_large_is_refused(tmp_path, make):
    read = make(tmp_path)
    tracemalloc.start()
    try:
        message = refusal(read, MapError)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert message.startswith(f"{tmp_path}")
    assert "expected at most" in message or "exceeds limit" in message
    assert most < 2**24
