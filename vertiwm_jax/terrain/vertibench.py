"""Reads the worlds of a Verti-Bench checkout (RobotiXX/verti_bench).

A world has a gray height map with one vertex a meter, patches of 8 m with a class and a friction,
and rocks and trees. Soils are where the labels say, which differs from that simulator.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from vertiwm_jax.errors import refusing
from vertiwm_jax.terrain.classes import STANDARD
from vertiwm_jax.terrain.map import MapError, TerrainMap, stack
from vertiwm_jax.terrain.worlds import CELLS, HALF_EXTENT, ROCK_SIZE, TREE_SIZE, VERTICES

_FOLDER = Path("envs/data/BenchMaps/sampled_maps")


def load(folder: str | Path) -> TerrainMap:
    """Stacks the worlds of a checkout, in the order of their numbers.

    Raises `MapError` naming the file and the field.
    """
    maps = Path(folder) / _FOLDER
    if not (maps / "Worlds").is_dir():
        expected = f"a checkout that holds {_FOLDER / 'Worlds'}"
        raise MapError(str(folder), "folder", expected, "no such folder")
    images = [image for image in (maps / "Worlds").glob("*.bmp") if image.stem.isdigit()]
    images.sort(key=lambda image: int(image.stem))
    paths = [_config_path(maps, image.stem) for image in images]
    worlds = [_world(image, path) for image, path in zip(images, paths, strict=True)]
    return stack(worlds, [str(path) for path in paths])


def _config_path(maps: Path, number: str) -> Path:
    found = sorted((maps / "Configs/Final").glob(f"config{number}_*.yaml"))
    if len(found) != 1:
        raise MapError(
            str(maps / "Configs/Final"), f"world {number}",
            f"one file config{number}_{{low,mid,high}}.yaml", f"{[f.name for f in found]}",
        )  # fmt: skip
    return found[0]


def _world(image: Path, path: Path) -> TerrainMap:
    name = str(path)
    # The C loader is ten times as fast, where PyYAML was built with it.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    with refusing(partial(MapError, name, "file", "Verti-Bench's YAML")):
        config = yaml.load(path.read_text(), Loader=loader)
        classes, friction = _patches(config["textures"])
        return TerrainMap.from_array(
            _gray(image) * (float(config["terrain"]["max_height"]) / 255),
            classes,
            resolution=1.0,
            # The look-ups of Verti-Bench use half a size of 64.5 m: half a meter off its ground.
            origin=(-HALF_EXTENT, HALF_EXTENT),
            friction=friction,
            obstacles=_obstacles(config["obstacles"]),
            name=name,
        )


def _gray(path: Path) -> np.ndarray:
    expected = "an 8-bit gray BMP"
    refused = refusing(partial(MapError, str(path), "elevation", expected))
    with refused, Image.open(path, formats=["BMP"]) as image:
        if image.size != (VERTICES, VERTICES):
            expected = f"{VERTICES} x {VERTICES} pixels"
            raise MapError(str(path), "elevation", expected, f"{image.size}")
        return np.asarray(image.convert("L"), np.float32)


def _patches(textures: list[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """`[16, 16]` class ids, -1 where there is none, and friction; row 0 is north, column 0 west."""
    ids = {name: k for k, name in enumerate(STANDARD.names)}
    classes, friction = np.full((CELLS, CELLS), -1), np.zeros((CELLS, CELLS))
    for texture in textures:
        row, column = (range(CELLS).index(i) for i in texture["index"])
        kind = texture["terrain_type"]
        classes[row, column] = ids[kind]
        if kind not in STANDARD.soils:
            friction[row, column] = texture["friction"]
    return classes, friction


def _obstacles(config: dict[str, list[dict[str, Any]]]) -> np.ndarray:
    """`[N, 5]`; their stored heights above the ground's datum are wrong and not used."""
    rocks = [(r["position"], r["scale"] * np.array(ROCK_SIZE)) for r in config["rocks"]]
    trees = [(t["position"], np.array(TREE_SIZE)) for t in config["trees"]]
    rows = [(place["x"], place["y"], *size) for place, size in rocks + trees]
    return np.array(rows, np.float32).reshape(-1, 5)
