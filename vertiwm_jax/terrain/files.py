"""Maps on disk: the `.npz` layout of the Chrono drives, and a user's own height map."""

import io
import json
import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image

from vertiwm_jax import arrays, atomic, froude
from vertiwm_jax.errors import refusing
from vertiwm_jax.precision import float32
from vertiwm_jax.terrain import geotiff, query, soil, vertibench
from vertiwm_jax.terrain.classes import STANDARD, GroundClasses
from vertiwm_jax.terrain.geotiff import Raster
from vertiwm_jax.terrain.map import MapError, TerrainMap, bounded, expect_room, stack
from vertiwm_jax.terrain.soil import Soil

# How Chrono calls our soil parameters, and how many of its units make one of ours.
_SOIL_FIELDS = {
    "Bekker_Kphi": ("kphi", 1.0),
    "Bekker_Kc": ("kc", 1.0),
    "Bekker_n": ("n", 1.0),
    "Mohr_cohesion": ("cohesion", 1.0),
    "Mohr_friction_deg": ("friction_angle", math.degrees(1.0)),
    "Janosi_shear": ("shear_modulus", 1.0),
    "unit_weight": ("unit_weight", 1.0),
}


_ARRAYS = (
    "elevation",
    "patch_class",
    "patch_friction",
    "obstacles",
    "origin",
    "resolution",
    "class_rgb",
    "meta",
)
_IMAGES = ("PNG", "BMP", "GIF", "JPEG", "PPM")


@float32
def load_map(
    path: str | Path, *, scale: float = 1.0, obstacles: bool = True, least: float = 0.0
) -> TerrainMap:
    """Loads a map, or all maps of a folder.

    Args:
        path: an `.npz` map, a folder of them, or a checkout of Verti-Bench.
        scale: of a small vehicle, as in its file; the ground becomes as large as it does.
        obstacles: whether the rocks and trees of the maps stand there.
        least: m that each side has at least, as large as the ground becomes.

    Returns:
        W worlds, stacked in the order of their names, of which the first is selected. Soils come
        from the file; what it does not say of a soil (its unit weight) comes from the preset of
        the same name.

    Raises:
        MapError: a file is missing or malformed, or the map too small; the message names it and
            the field.
    """
    path = Path(path)
    if not path.exists():
        raise MapError(str(path), "file", "an .npz map, or a folder of them", "no such file")
    if (path / "envs").is_dir():
        terrain = vertibench.load(path)
    elif path.is_dir():
        files = sorted(path.glob("*.npz"))
        if not files:
            raise MapError(str(path), "folder", "one .npz map or more", "none")
        terrain = stack([_load_world(file) for file in files], [str(file) for file in files])
    else:
        terrain = _load_world(path)
    terrain = froude.scaled(terrain, scale)
    at_scale = "" if scale == 1 else f", {scale:g} times as large"
    expect_room(terrain, least, f"{path}{at_scale}")
    return terrain if obstacles else replace(terrain, obstacles=terrain.obstacles[:, :0])


def save(terrain: TerrainMap, path: str | Path) -> None:
    """Writes the selected world in the layout that `load_map` reads; whole or not at all.

    Raises `WriteError` where that is not possible.
    """
    world, deformable = int(terrain.world), np.asarray(terrain.deformable)
    semantic, offset = np.asarray(terrain.semantic[world]), terrain.offset()
    obstacles = np.asarray(terrain.obstacles[world], np.float64)
    obstacles = obstacles[(obstacles != 0).any(axis=1)] + [*offset, 0, 0, 0]
    of_class = query.soils(terrain)
    soils = {
        name: soil_of_chrono(of_class, k)
        for k, name in enumerate(terrain.class_names)
        if deformable[k]
    }
    meta = {"classes": terrain.class_names, "soil_fields": list(_SOIL_FIELDS), "soils": soils}
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        elevation=terrain.elevation[world],
        resolution=terrain.resolution,
        origin=np.asarray(terrain.origin, np.float64) + offset,
        class_rgb=terrain.class_rgb,
        patch_class=semantic,
        patch_friction=np.where(deformable[semantic], np.float32(np.nan), terrain.friction[world]),
        obstacles=obstacles,
        meta=np.array(json.dumps(meta)),
    )
    atomic.write(path, stream.getvalue())


def soil_of_chrono(soils: Soil, kind: int) -> list[float]:
    """The soil of a class as Chrono's SCM takes it, and its unit weight; soils: leaves `[K]`."""
    return [float(getattr(soils, field)[kind]) * unit for field, unit in _SOIL_FIELDS.values()]


def from_heightmap(
    path: str | Path,
    resolution: float | None = None,
    height_range: tuple[float, float] | None = None,
    class_image: str | Path | None = None,
    default_class: str = "grass",
    ground: GroundClasses = STANDARD,
    origin: tuple[float, float] | None = None,
    height_offset: float = 0.0,
) -> TerrainMap:
    """Makes a map from heights in a 16-bit PNG, `.npy` or GeoTIFF file; row 0 is north.

    Args:
        path: the file.
        resolution: m between pixels; may be left out for a GeoTIFF that tells it.
        height_range: heights in m of the darkest and the brightest integer that a pixel can hold;
            without it, values are meters.
        class_image: an 8-bit image of ids, or an RGB image of the palette's colors, over the same
            extent at any resolution; also a `.npy` or GeoTIFF file.
        default_class: all ground, where there is no such image.
        ground: the classes of ground that ids and colors refer to.
        origin: x, y of the first pixel, m; by default that of a GeoTIFF, while other maps are
            centered.
        height_offset: m that are added to all heights.

    Raises:
        MapError: a file is missing or malformed, or a GeoTIFF says something else; the message
            names the file and the field.
    """
    name, raster = str(path), _read_raster(Path(path), "elevation", geotiff.heights)
    heights, resolution = raster.pixels, _agreed(name, resolution, raster.size)
    if height_range is not None:
        if not np.issubdtype(heights.dtype, np.unsignedinteger):
            raise MapError(
                name, "height_range", "unsigned integers to scale", f"dtype {heights.dtype}",
                "leave height_range out: the values are taken as meters",
            )  # fmt: skip
        low, high = height_range
        heights = low + heights * ((high - low) / np.iinfo(heights.dtype).max)
    classes = default_class
    if class_image is not None:
        classes = _read_classes(Path(class_image), ground, raster)
        name = f"{name} with {class_image}"
    return TerrainMap.from_array(
        heights + height_offset if height_offset else heights,
        classes,
        resolution=resolution,
        origin=raster.origin if origin is None else origin,
        ground=ground,
        name=name,
    )


def _agreed(name: str, asked: float | None, told: float | None) -> float:
    """Meters between pixels, by the caller and by the file; raises `MapError` unless they agree."""
    if told is None:
        if asked is None:
            expected = "meters between pixels, which the file does not tell"
            raise MapError(name, "resolution", expected, "none")
        return asked
    if asked is not None and not math.isclose(asked, told, rel_tol=1e-3):
        expected, mend = f"{told:.6g} m between pixels, as the file tells", "leave resolution out"
        raise MapError(name, "resolution", expected, f"{asked:g}", mend)
    return told


def _load_world(path: Path) -> TerrainMap:
    name = str(path)
    refused = refusing(partial(MapError, name, "file", "an .npz map"))
    with refused:
        file = arrays.load_archive(path, _ARRAYS)
        if missing := [key for key in _ARRAYS if key not in file]:
            raise KeyError(f"{missing[0]} is not a file in the archive")
        return TerrainMap.from_array(
            file["elevation"],
            file["patch_class"],
            resolution=float(file["resolution"]),
            origin=file["origin"],
            friction=file["patch_friction"],
            obstacles=file["obstacles"],
            ground=_classes(json.loads(str(file["meta"])), file["class_rgb"], name),
            name=name,
        )


def _classes(meta: dict, rgb: np.ndarray, name: str) -> GroundClasses:
    names = tuple(meta["classes"])
    if unknown := set(meta["soils"]) - set(names):
        raise MapError(name, "meta.soils", f"soils among {', '.join(names)}", f"{sorted(unknown)}")
    soils = {}
    for key, values in meta["soils"].items():
        if len(values) != len(meta["soil_fields"]):
            expected = f"{len(meta['soil_fields'])} numbers, as in meta.soil_fields"
            raise MapError(name, f"meta.soils.{key}", expected, f"{len(values)}")
        soils[key] = _soil(key, dict(zip(meta["soil_fields"], values, strict=True)), name)
    # What friction the classes have on average is not in the file: every patch has its own.
    return GroundClasses(names, rgb, np.zeros(len(names)), soils)


def _soil(key: str, values: dict[str, float], name: str) -> Soil:
    known = {
        field: jnp.float32(values[chrono] / unit)
        for chrono, (field, unit) in _SOIL_FIELDS.items()
        if chrono in values
    }
    if key in soil.PRESETS:
        return replace(soil.PRESETS[key], **known)
    missing = [c for c, (field, _) in _SOIL_FIELDS.items() if field not in known]
    if missing:
        raise MapError(
            name, f"meta.soils.{key}", f"all of {', '.join(_SOIL_FIELDS)}", f"no {missing}",
            "add them, or use the name of a preset",
        )  # fmt: skip
    return Soil(**known)


def _read_raster(path: Path, field: str, from_geotiff: Callable[[Path, str], Raster]) -> Raster:
    """The pixels of an image, GeoTIFF or `.npy` file."""
    with refusing(partial(MapError, str(path), field, "a PNG, .npy or GeoTIFF file")):
        suffix = path.suffix.lower()
        if suffix == ".npy":
            return Raster(arrays.load(path))
        if suffix in (".tif", ".tiff"):
            return from_geotiff(path, field)
        # Pillow warns where a file is large or odd.
        with warnings.catch_warnings(action="ignore"), Image.open(path, formats=_IMAGES) as image:
            bounded(str(path), field, (image.height, image.width))
            colored = image.mode in ("P", "RGBA")
            return Raster(np.asarray(image.convert("RGB") if colored else image))


def _read_classes(path: Path, classes: GroundClasses, heights: Raster) -> np.ndarray:
    """`[r, c]` class ids from an image of ids or of palette colors."""
    raster = _read_raster(path, "class_image", geotiff.classes)
    pixels = raster.pixels
    found, wanted = raster.edges, heights.edges
    if (np.abs(found - wanted) > (raster.size or 0) + (heights.size or 0)).any():
        expected, found = (", ".join(f"{x:.10g}" for x in edges) for edges in (wanted, found))
        raise MapError(
            str(path), "class_image", f"the edges of the heights (x, y: {expected})", found,
            f"cut it, for example by `gdalwarp -te {expected.replace(',', '')} a.tif b.tif`",
        )  # fmt: skip
    if pixels.ndim == 2:
        return pixels
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise MapError(str(path), "class_image", "ids or RGB colors", f"shape {pixels.shape}")
    matches = (pixels[:, :, None] == classes.rgb).all(-1)
    unknown = np.argwhere(~matches.any(-1))
    if len(unknown):
        row, column = unknown[0]
        palette = ", ".join(
            f"{n} {tuple(c)}" for n, c in zip(classes.names, classes.rgb.tolist(), strict=True)
        )
        found = f"{tuple(pixels[row, column].tolist())} at row {row}, column {column}"
        raise MapError(
            str(path), "class_image", f"colors of the palette ({palette})",
            f"{found} ({len(unknown)} such)", "save it without smoothing or compression loss",
        )  # fmt: skip
    return matches.argmax(-1).astype(np.uint8)
