"""What a GeoTIFF says of itself counts: the map is as it says, or a `MapError` tells of it."""

import numpy as np
import pytest
import tifffile
from faults.border import fault, outcome
from PIL import Image

from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import MapError

SIZE = 33
RAMP = np.linspace(2, 9, SIZE * SIZE).reshape(SIZE, SIZE).astype(np.float32)
METRE, US_FOOT, DEGREE = 9001, 9003, 9102
EAST, NORTH = 500000.0, 4500000.0


def scale(x, y):
    """Tags of pixels of this size, the first of which lies in the north-west."""
    return [(33550, "d", 3, (x, y, 0.0), True), (33922, "d", 6, (0, 0, 0, EAST, NORTH, 0), True)]


def transformed(*matrix):
    """The tag by which columns and rows become x and y."""
    (x_of_column, x_of_row), (y_of_column, y_of_row) = matrix
    rows = (x_of_column, x_of_row, 0, EAST, y_of_column, y_of_row, 0, NORTH, 0, 0, 0, 0, 0, 0, 0, 1)
    return [(34264, "d", 16, rows, True)]


def keys(**values):
    """The tag of the coordinate system: 1 is projected, 2 geographic."""
    numbers = {"model": 1024, "angles": 2054, "lengths": 3076, "heights": 4099}
    entries = sorted((numbers[name], 0, 1, value) for name, value in values.items())
    words = [1, 1, 0, len(entries), *(word for entry in entries for word in entry)]
    return [(34735, "H", len(words), words, True)]


def text(code, value):
    return [(code, "s", 0, value, True)]


def write(path, tags, heights=RAMP):
    tifffile.imwrite(path, heights, extratags=tags, metadata=None)
    return path


def test_a_map_that_the_call_agrees_with_is_read(tmp_path):
    path = write(tmp_path / "a.tif", scale(0.5, 0.5) + keys(model=1, lengths=METRE))
    terrain = files.from_heightmap(path, 0.5)
    np.testing.assert_array_equal(terrain.elevation[0], RAMP)
    assert terrain.resolution == 0.5


CONTRADICTED = {
    "half a metre": (1.0, scale(0.5, 0.5)),
    "not square": (1.0, scale(1.0, 2.0)),
    "degrees": (1.0, scale(1 / 3600, 1 / 3600)),
    "degrees by name": (30.0, scale(1 / 3600, 1 / 3600) + keys(model=2, angles=DEGREE)),
    "feet": (1.0, scale(1.0, 1.0) + keys(model=1, lengths=US_FOOT)),
    "turned by an eighth": (1.0, transformed((0.7, -0.7), (0.7, 0.7))),
    "turned by a quarter": (1.0, transformed((0.0, -1.0), (-1.0, 0.0))),
}


@pytest.mark.parametrize("case", CONTRADICTED)
@fault(pytest.fail.Exception, "tags that contradict the call are not looked at")
def test_pixels_of_another_size_or_direction_are_refused(tmp_path, case):
    resolution, tags = CONTRADICTED[case]
    path = write(tmp_path / "a.tif", tags)
    with pytest.raises(MapError) as refused:
        files.from_heightmap(path, resolution)
    assert str(refused.value).startswith(f"{path}: ") and "\n" not in str(refused.value)


MEANT = {
    "rows to the north": (transformed((1.0, 0.0), (0.0, 1.0)), RAMP, RAMP[::-1]),
    "rows to the north by scale": (scale(1.0, -1.0), RAMP, RAMP[::-1]),
    "heights in feet": (keys(heights=US_FOOT), RAMP, RAMP * (1200 / 3937)),
    "scale and offset": (
        text(
            42112,
            '<GDALMetadata><Item name="OFFSET" sample="0" role="offset">2</Item>'
            '<Item name="SCALE" sample="0" role="scale">0.01</Item></GDALMetadata>',
        ),
        np.rint(100 * RAMP - 200).astype(np.int16) // 50,
        2 + 0.01 * (np.rint(100 * RAMP - 200).astype(np.int16) // 50),
    ),
}


@pytest.mark.parametrize("case", MEANT)
@fault(AssertionError, "tags of what the numbers mean are not looked at")
def test_heights_are_what_is_meant(tmp_path, case):
    tags, stored, heights = MEANT[case]
    path = write(tmp_path / "a.tif", tags, stored)
    terrain, _ = outcome(lambda: files.from_heightmap(path, 1.0), MapError)
    if terrain:
        np.testing.assert_allclose(terrain.elevation[0], heights, rtol=1e-5)


def holed(path, nodata):
    """Heights of 2 m and more, but for a corner where there are none."""
    heights = RAMP.copy()
    heights[:3, :3] = nodata
    return write(path, text(42113, f"{nodata}"), heights)


@pytest.mark.parametrize("nodata", [0, -9999, -32768])
def test_no_height_is_not_taken_for_one(tmp_path, nodata):
    path = holed(tmp_path / "a.tif", nodata)
    with pytest.raises(MapError, match=r"9 that are .*, no data; fill the holes"):
        files.from_heightmap(path, 1.0)


COMPRESSIONS = {
    "LZW": {"compression": "tiff_lzw"},
    "LZW with differences": {"compression": "tiff_lzw", "tiffinfo": {317: 2}},
    "LZW with differences of floats": {"compression": "tiff_lzw", "tiffinfo": {317: 3}},
    "deflate with differences of floats": {
        "compression": "tiff_adobe_deflate", "tiffinfo": {317: 3},
    },
}  # fmt: skip


@pytest.mark.parametrize("case", COMPRESSIONS)
@fault(MapError, "the geotiff extra lacks the package that decompresses")
def test_usual_compressions_are_read(tmp_path, case):
    Image.fromarray(RAMP).save(tmp_path / "a.tif", **COMPRESSIONS[case])
    terrain = files.from_heightmap(tmp_path / "a.tif", 1.0)
    np.testing.assert_array_equal(terrain.elevation[0], RAMP)


def test_other_compressions_are_read_or_refused(tmp_path):
    Image.fromarray(RAMP).save(tmp_path / "a.tif", compression="zstd")
    terrain, _ = outcome(lambda: files.from_heightmap(tmp_path / "a.tif", 1.0), MapError)
    if terrain:
        np.testing.assert_array_equal(terrain.elevation[0], RAMP)


def test_a_height_map_can_be_placed(tmp_path):
    path = write(tmp_path / "a.tif", scale(1.0, 1.0), RAMP + 400)
    terrain = files.from_heightmap(path, 1.0, origin=(100.0, 250.0))
    np.testing.assert_array_equal(terrain.origin, (100, 250))
    np.testing.assert_allclose(terrain.elevation[0], RAMP + 400, atol=1e-4)
