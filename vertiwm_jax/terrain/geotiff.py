"""Reads GeoTIFFs as what their tags say they are, by GDAL."""

import logging
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from vertiwm_jax.errors import needs
from vertiwm_jax.terrain.map import MapError, bounded

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

_METERS = {"metre": 1.0, "foot": 0.3048, "US survey foot": 1200 / 3937}
_OTHER_NAMES = {
    **dict.fromkeys(("m", "meter", "meters", "metres"), "metre"),
    **dict.fromkeys(("ft", "feet", "international foot"), "foot"),
    **dict.fromkeys(("us-ft", "ftus", "us survey feet"), "US survey foot"),
}
_KEYS, _LENGTHS = 34735, 3076  # the tag of GeoTIFF's keys, and that of lengths among them
_UNITS = {9001: "metre", 9002: "foot", 9003: "US survey foot"}
_BIG = 43  # third byte of TIFFs of more than 4 GB
_SQUARE = 1e-3  # by which share sides of pixels may differ
_STRAIGHT = 1e-6  # by which they may lean
_FINEST = 1e-3  # pixels of fewer m are of degrees


@dataclass(frozen=True)
class Raster:
    """pixels: `[R, C]` or, of colors, `[R, C, 3]`; row 0 is north, column 0 west.

    size: of a pixel, m; origin: x, y of the middle of pixel (0, 0), m. None where the file does
    not say where it lies.
    """

    pixels: np.ndarray
    size: float | None = None
    origin: tuple[float, float] | None = None

    @property
    def edges(self) -> np.ndarray:
        """`[4]` least x and y and largest x and y of its pixels, m; NaN where that is not known."""
        if self.size is None or self.origin is None:
            return np.full(4, np.nan)
        (x, y), (rows, columns) = self.origin, self.pixels.shape[:2]
        west, north = x - self.size / 2, y + self.size / 2
        return np.array([west, north - rows * self.size, west + columns * self.size, north])


def heights(path: Path, field: str) -> Raster:
    """Heights, m, of the only band of the file; raises `MapError`, which names the field."""
    with _opened(path, field) as (file, located):
        name = str(path)
        if file.count != 1:
            raise MapError(
                name, field, "one band, of heights", f"{file.count} bands",
                "choose one, for example by `gdal_translate -b 1`",
            )  # fmt: skip
        unit = file.units[0] or "metre"
        unit = _OTHER_NAMES.get(unit.lower(), unit)
        if unit not in _METERS:
            raise MapError(name, field, f"heights in {', '.join(_METERS)}", f"heights in {unit}")
        raster = _raster(file, located, name, field)
        factor, zero = file.scales[0], file.offsets[0]
        if (factor, zero, unit) == (1.0, 0.0, "metre"):
            return raster
        values = (raster.pixels * factor + zero) * _METERS[unit]
        return Raster(values, raster.size, raster.origin)


def classes(path: Path, field: str) -> Raster:
    """Class ids, or colors of three bands; raises `MapError`, which names the field."""
    with _opened(path, field) as (file, located):
        if file.count not in (1, 3):
            found = f"{file.count} bands"
            raise MapError(str(path), field, "one band of ids, or three of colors", found)
        return _raster(file, located, str(path), field)


@contextmanager
def _opened(path: Path, field: str) -> Iterator[tuple["DatasetReader", bool]]:
    """The open file, and whether it says where it lies. Nothing is written to the terminal."""
    with needs("rasterio", "geotiff", f"{path}: {field}"):
        import rasterio
        from rasterio.errors import NotGeoreferencedWarning, RasterioIOError

    log = logging.getLogger("rasterio")
    quiet, propagated = logging.NullHandler(), log.propagate
    log.addHandler(quiet)
    log.propagate = False
    try:
        with (
            warnings.catch_warnings(record=True) as said,
            rasterio.Env(GTIFF_HONOUR_NEGATIVE_SCALEY=True),
        ):
            warnings.simplefilter("always")
            with rasterio.open(path, driver="GTiff") as file:
                located = not any(w.category is NotGeoreferencedWarning for w in said)
                yield file, located
    except RasterioIOError as error:
        raise (error.__cause__ or error) from None  # What GDAL says tells more.
    finally:
        log.propagate = propagated
        log.removeHandler(quiet)


def _raster(file: "DatasetReader", located: bool, name: str, field: str) -> Raster:
    bounded(name, field, (file.count, *file.shape))
    size, origin, across, down = None, None, 1, 1
    if located:
        size, origin, across, down = _place(file, name, field)
    pixels = np.squeeze(np.moveaxis(file.read(), 0, -1), axis=-1 if file.count == 1 else ())
    if holes := np.sum(_missing(file)):
        value = "masked" if file.nodata is None else f"{file.nodata:g}"
        raise MapError(
            name, field, "a value in every pixel", f"{holes} that are {value}, no data",
            "fill the holes, for example by `gdal_fillnodata`",
        )  # fmt: skip
    return Raster(pixels[::down, ::across], size, origin)


def _place(
    file: "DatasetReader", name: str, field: str
) -> tuple[float, tuple[float, float], int, int]:
    """Size of pixels, m; x, y of the north-western one; steps by which columns go east, rows south.

    Raises `MapError` unless pixels are squares in meters, along x and y.
    """
    x_of_column, x_of_row, west, y_of_column, y_of_row, north = file.transform[:6]
    zone = "EPSG:..."
    if abs(west) <= 180 and abs(north) <= 84:
        zone = f"EPSG:{326 if north >= 0 else 327}{min(int(west / 6 + 31), 60):02}"

    def refuse(expected: str, found: str, option: str) -> None:
        mend = f"bring it there, for example by `gdalwarp {option}`"
        raise MapError(name, field, expected, found, mend)

    turned = abs(x_of_row) + abs(y_of_column) > _STRAIGHT * abs(x_of_column)
    if turned or file.gcps[0] or file.rpcs:
        found = "a transform that turns them" if turned else "control points or polynomials"
        refuse("pixels along x and y", found, "-r bilinear a.tif b.tif")
    unit = _unit(file)
    tiny = unit is None and abs(x_of_column) < _FINEST
    if tiny or unit not in ("metre", None):
        found = f"{unit or 'unknown units'}, {abs(x_of_column):.6g} a pixel"
        refuse("coordinates in meters", found, f"-t_srs {zone} -r bilinear a.tif b.tif")
    sides = abs(x_of_column), abs(y_of_row)
    if not (0 < sides[0] < math.inf and abs(sides[1] / sides[0] - 1) < _SQUARE):
        found = f"{sides[0]:.6g} x {sides[1]:.6g} m"
        refuse("square pixels", found, f"-tr {min(sides):.6g} {min(sides):.6g} a.tif b.tif")
    row, column = (file.height - 1) * (y_of_row > 0), (file.width - 1) * (x_of_column < 0)
    x, y = file.xy(row, column)
    across, down = 1 if x_of_column > 0 else -1, 1 if y_of_row < 0 else -1
    return sides[0], (float(x), float(y)), across, down


def _unit(file: "DatasetReader") -> str | None:
    """Of the coordinates; None where the file has no coordinate system."""
    crs = file.crs
    if crs is None:
        return None
    if crs.is_geographic:
        return "degrees"
    if crs.is_projected:
        unit, meters = crs.linear_units_factor
        return "metre" if meters == 1 else unit
    # Of a local system GDAL reads no unit.
    with open(file.name, "rb") as stream:
        head = stream.read(8)
        directory = ImageFileDirectory_v2(head + stream.read(8 * (head[2] == _BIG)))
        stream.seek(directory.next)
        directory.load(stream)
    words = directory.get(_KEYS, ())
    keys = {words[i]: words[i + 3] for i in range(4, len(words) - 3, 4)}
    return _UNITS.get(keys.get(_LENGTHS, 9001), "another unit")


def _missing(file: "DatasetReader") -> np.ndarray:
    """`[R, C]` whether a pixel has no value: by nodata, by a mask, or because it is not stored."""
    missing = file.dataset_mask() == 0
    for (down, across), window in file.block_windows(1):
        if file.get_tag_item(f"BLOCK_OFFSET_{across}_{down}", "TIFF", bidx=1) is None:
            missing[window.toslices()] = True
    return missing
