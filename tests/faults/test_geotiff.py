"""What a GeoTIFF says of itself counts: the map is as it says, or a `MapError` tells of it."""

import numpy as np
import pytest
import rasterio
from affine import Affine
from faults.border import outcome
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2
from rasterio.control import GroundControlPoint

from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.classes import STANDARD
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
    numbers = {"model": 1024, "raster": 1025, "angles": 2054, "lengths": 3076, "heights": 4099}
    entries = sorted((numbers[name], 0, 1, value) for name, value in values.items())
    words = [1, 1, 0, len(entries), *(word for entry in entries for word in entry)]
    return [(34735, "H", len(words), words, True)]


def text(code, value):
    return [(code, "s", 0, value, True)]


TYPES = {"s": 2, "H": 3, "d": 12}


def write(path, tags, heights=RAMP, **options):
    directory = ImageFileDirectory_v2()
    for code, kind, _, value, _ in tags:
        directory.tagtype[code] = TYPES[kind]
        directory[code] = value
    Image.fromarray(heights).save(path, tiffinfo=directory, **options)
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
        np.rint(100 * RAMP - 200).astype(np.uint16) // 50,
        2 + 0.01 * (np.rint(100 * RAMP - 200).astype(np.uint16) // 50),
    ),
}


@pytest.mark.parametrize("case", MEANT)
def test_heights_are_what_is_meant(tmp_path, case):
    tags, stored, heights = MEANT[case]
    path = write(tmp_path / "a.tif", tags, stored)
    terrain = files.from_heightmap(path, 1.0)
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
def test_usual_compressions_are_read(tmp_path, case):
    Image.fromarray(RAMP).save(tmp_path / "a.tif", **COMPRESSIONS[case])
    terrain = files.from_heightmap(tmp_path / "a.tif", 1.0)
    np.testing.assert_array_equal(terrain.elevation[0], RAMP)


def test_other_compressions_are_read_or_refused(tmp_path):
    Image.fromarray(RAMP).save(tmp_path / "a.tif", compression="zstd")
    terrain, _ = outcome(lambda: files.from_heightmap(tmp_path / "a.tif", 1.0), MapError)
    if terrain:
        np.testing.assert_array_equal(terrain.elevation[0], RAMP)


def referenced(path, heights=RAMP, size=1.0, crs="EPSG:32632", **profile):
    """What GDAL writes."""
    bands = np.atleast_3d(heights) if heights.ndim == 2 else heights
    rows, columns, count = bands.shape
    profile = {"transform": Affine(size, 0, EAST, 0, -size, NORTH), "crs": crs} | profile
    profile |= {"width": columns, "height": rows, "count": count, "dtype": bands.dtype}
    with rasterio.open(path, "w", driver="GTiff", **profile) as file:
        file.write(np.moveaxis(bands, -1, 0))
    return path


def test_what_the_file_says_may_be_left_out(tmp_path):
    terrain = files.from_heightmap(referenced(tmp_path / "a.tif", size=0.5))
    assert terrain.resolution == 0.5
    np.testing.assert_array_equal(terrain.elevation[0], RAMP)
    # Vertices are the middles of pixels.
    corner = np.asarray(terrain.origin) + terrain.offset()
    np.testing.assert_allclose(corner, [EAST + 0.25, NORTH - 0.25], rtol=0, atol=1e-6)
    flipped = Affine(-0.5, 0, EAST + SIZE / 2, 0, 0.5, NORTH - SIZE / 2)
    path = referenced(tmp_path / "b.tif", RAMP[::-1, ::-1], transform=flipped)
    again = files.from_heightmap(path)
    np.testing.assert_array_equal(again.elevation[0], RAMP)
    assert again.offset().tolist() == terrain.offset().tolist()


def test_the_middle_of_a_pixel_may_be_a_point(tmp_path):
    point = (*scale(1.0, 1.0), *keys(model=1, raster=2, lengths=METRE))
    terrain = files.from_heightmap(write(tmp_path / "a.tif", point))
    np.testing.assert_allclose(np.asarray(terrain.origin) + terrain.offset(), [EAST, NORTH])


def test_a_world_file_places_a_map(tmp_path):
    Image.fromarray(RAMP).save(tmp_path / "a.tif")
    numbers = (0.25, 0, 0, -0.25, EAST, NORTH)
    (tmp_path / "a.tfw").write_text("".join(f"{x}\n" for x in numbers))
    terrain = files.from_heightmap(tmp_path / "a.tif")
    assert terrain.resolution == 0.25
    np.testing.assert_allclose(np.asarray(terrain.origin) + terrain.offset(), [EAST, NORTH])


def test_what_nobody_says_is_asked_for(tmp_path):
    np.save(tmp_path / "a.npy", RAMP)
    for path in (write(tmp_path / "a.tif", []), tmp_path / "a.npy"):
        with pytest.raises(MapError, match=r"resolution: expected meters .* not tell, found none"):
            files.from_heightmap(path)


COORDINATES = {
    "longitude": (
        {"crs": "EPSG:4326", "transform": Affine(1e-5, 0, 8.5, 0, -1e-5, 47)},
        "EPSG:32632",
    ),
    "southern latitude": (
        {"crs": "EPSG:4326", "transform": Affine(1e-5, 0, -179.9, 0, -1e-5, -40)},
        "EPSG:32701",
    ),
    "degrees without a name": ({"crs": None, "size": 1e-5}, "EPSG:..."),
    "feet": ({"crs": "EPSG:2229"}, "found US survey foot"),
    "feet and heights": ({"crs": "EPSG:2229+6360"}, "found US survey foot"),
    "oblong": ({"transform": Affine(1, 0, EAST, 0, -2, NORTH)}, "found 1 x 2 m; .*-tr 1 1"),
    "turned": ({"transform": Affine(1, 0.1, EAST, -0.1, -1, NORTH)}, "a transform that turns"),
    "control points": (
        {"transform": None, "gcps": [
            GroundControlPoint(row, column, EAST + column, NORTH - row)
            for row in (0, 9) for column in (0, 9)
        ]},
        "control points",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", COORDINATES)
def test_other_coordinates_are_refused_with_what_brings_them_to_metres(tmp_path, case):
    profile, message = COORDINATES[case]
    path = referenced(tmp_path / "a.tif", **profile)
    with pytest.raises(MapError, match=rf"a\.tif: elevation: .*{message}") as refused:
        files.from_heightmap(path)
    assert "`gdalwarp " in str(refused.value)


def test_another_size_is_told(tmp_path):
    path = referenced(tmp_path / "a.tif", size=0.5)
    message = r"resolution: expected 0\.5 m .* as the file tells, found 1; leave resolution out"
    with pytest.raises(MapError, match=message):
        files.from_heightmap(path, 1.0)
    np.testing.assert_allclose(files.from_heightmap(path, 0.5001).resolution, 0.5)


@pytest.mark.parametrize(
    ("crs", "unit"), [("EPSG:26911+5703", 1.0), ("EPSG:26911+6360", 1200 / 3937)]
)
def test_the_unit_of_heights_is_that_of_their_system(tmp_path, crs, unit):
    terrain = files.from_heightmap(referenced(tmp_path / "a.tif", crs=crs))
    np.testing.assert_allclose(terrain.elevation[0], unit * RAMP, rtol=1e-6)


def test_heights_in_another_unit_are_refused(tmp_path):
    path = referenced(tmp_path / "a.tif")
    with rasterio.open(path, "r+") as file:
        file.units = ["fathom"]
    with pytest.raises(MapError, match=r"heights in metre, foot, .* found heights in fathom"):
        files.from_heightmap(path)


def holes(path, case):
    """A file in which a corner has no height, said in one of several ways."""
    heights, corner = RAMP.copy(), (slice(3), slice(3))
    if case == "not stored":
        with rasterio.open(
            path, "w", driver="GTiff", width=64, height=64, count=1, dtype="float32",
            tiled=True, blockxsize=16, blockysize=16, sparse_ok=True,
        ) as file:  # fmt: skip
            file.write(np.ones((16, 64), np.float32), 1, window=((0, 16), (0, 64)))
        return
    if case == "NaN":
        heights[corner] = np.nan
    referenced(path, heights, nodata=np.nan if case == "NaN" else None)
    if case == "mask":
        known = np.full(RAMP.shape, 255, np.uint8)
        known[corner] = 0
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as file:
            file.write_mask(known)


HOLES = {"NaN": "9 that are nan", "mask": "9 that are masked", "not stored": "3072 that are masked"}


@pytest.mark.parametrize("case", HOLES)
def test_holes_are_counted(tmp_path, case):
    holes(tmp_path / "a.tif", case)
    with pytest.raises(
        MapError, match=f"{HOLES[case]}, no data; fill the holes, .*gdal_fillnodata"
    ):
        files.from_heightmap(tmp_path / "a.tif", 1.0)


@pytest.mark.parametrize("bands", [2, 3, 4])
def test_one_of_several_bands_has_to_be_chosen(tmp_path, bands):
    path = referenced(tmp_path / "a.tif", np.stack([RAMP] * bands, axis=-1))
    with pytest.raises(MapError, match=f"one band, of heights, found {bands} bands; .*-b 1"):
        files.from_heightmap(path)


def test_classes_lie_where_the_heights_do(tmp_path):
    heights = referenced(tmp_path / "a.tif")
    ids = (np.arange(SIZE * SIZE) % 10).reshape(SIZE, SIZE).astype(np.uint8)
    colors = STANDARD.rgb[ids]
    for name, pixels in (("ids.tif", ids), ("colors.tif", colors)):
        path = referenced(tmp_path / name, pixels)
        terrain = files.from_heightmap(heights, class_image=path)
        np.testing.assert_array_equal(terrain.semantic[0], ids)
    elsewhere = referenced(tmp_path / "b.tif", ids, transform=Affine(1, 0, EAST + 5, 0, -1, NORTH))
    message = r"b\.tif: class_image: expected the edges of the heights .* -te 500000 4499967 500033"
    with pytest.raises(MapError, match=message):
        files.from_heightmap(heights, class_image=elsewhere)
    # Where only one of them tells its place, both are taken to be of the same.
    files.from_heightmap(heights, class_image=write(tmp_path / "c.tif", [], ids))


def test_nothing_is_written_to_the_terminal(tmp_path, capfd):
    path = referenced(tmp_path / "a.tif")
    whole = path.read_bytes()
    path.write_bytes(whole[: 2 * len(whole) // 3])
    with pytest.raises(
        MapError, match=r"a\.tif: elevation: expected .* GeoTIFF file, found .*IReadBlock failed"
    ):
        files.from_heightmap(path)
    path.write_bytes(b"II*\0")
    with pytest.raises(MapError, match=r"a\.tif: elevation: expected .* GeoTIFF file"):
        files.from_heightmap(path)
    files.from_heightmap(write(path, [(65000, "H", 1, 3, True)]), 1.0)
    assert tuple(capfd.readouterr()) == ("", "")


def test_a_height_map_can_be_placed(tmp_path):
    path = write(tmp_path / "a.tif", scale(1.0, 1.0), RAMP + 400)
    terrain = files.from_heightmap(path, 1.0, origin=(100.0, 250.0))
    np.testing.assert_array_equal(terrain.origin, (100, 250))
    np.testing.assert_allclose(terrain.elevation[0], RAMP + 400, atol=1e-4)
    lowered = files.from_heightmap(path, height_offset=-400.0)
    np.testing.assert_allclose(lowered.elevation[0], RAMP, atol=1e-4)
