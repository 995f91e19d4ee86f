"""Maps on disk, in the `.npz` layout of the Chrono drives."""

import io
import json
import math
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from vertiwm_jax import atomic, froude
from vertiwm_jax.terrain import query, soil, vertibench
from vertiwm_jax.terrain.classes import GroundClasses
from vertiwm_jax.terrain.map import MapError, TerrainMap, refusing, stack
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


def load_map(path: str | Path, *, scale: float = 1.0, obstacles: bool = True) -> TerrainMap:
    """Loads a map, or all maps of a folder.

    Args:
        path: an `.npz` map, a folder of them, or a checkout of Verti-Bench.
        scale: of a small vehicle, as in its file; the ground becomes as large as it does.
        obstacles: whether the rocks and trees of the maps stand there.

    Returns:
        W worlds, stacked in the order of their names, of which the first is selected. Soils come
        from the file; what it does not say of a soil (its unit weight) comes from the preset of
        the same name.

    Raises:
        MapError: a file is missing or malformed; the message names it and the field.
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
    return terrain if obstacles else replace(terrain, obstacles=terrain.obstacles[:, :0])


def save(terrain: TerrainMap, path: str | Path) -> None:
    """Writes the selected world in the layout that `load_map` reads; whole or not at all.

    Raises `WriteError` where that is not possible.
    """
    world, deformable = int(terrain.world), np.asarray(terrain.deformable)
    semantic, obstacles = np.asarray(terrain.semantic[world]), np.asarray(terrain.obstacles[world])
    of_class = query.soils(terrain)
    soils = {
        name: [float(getattr(of_class, f)[k]) * unit for f, unit in _SOIL_FIELDS.values()]
        for k, name in enumerate(terrain.class_names)
        if deformable[k]
    }
    meta = {"classes": terrain.class_names, "soil_fields": list(_SOIL_FIELDS), "soils": soils}
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        elevation=terrain.elevation[world],
        resolution=terrain.resolution,
        origin=terrain.origin,
        class_rgb=terrain.class_rgb,
        patch_class=semantic,
        patch_friction=np.where(deformable[semantic], np.float32(np.nan), terrain.friction[world]),
        obstacles=obstacles[(obstacles != 0).any(axis=1)],
        meta=np.array(json.dumps(meta)),
    )
    atomic.write(path, stream.getvalue())


def _load_world(path: Path) -> TerrainMap:
    name = str(path)
    with refusing(name, "file", "an .npz map"), np.load(path, allow_pickle=False) as file:
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
