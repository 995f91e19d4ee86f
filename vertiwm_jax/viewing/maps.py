"""Maps from above, as a picture."""

import zipfile
from pathlib import Path

from vertiwm_jax import figures
from vertiwm_jax.terrain.files import load_map


def are_maps(source: Path) -> bool:
    """Whether a path is a map or a folder of maps, and not a run or a file of drives."""
    if source.is_dir():
        files = [*source.glob("*.npz"), *source.glob("envs")]
        return bool(files) and not (source / "config.yaml").exists()
    if not zipfile.is_zipfile(source):
        return False
    with zipfile.ZipFile(source) as file:
        return "elevation.npy" in file.namelist() and "state.npy" not in file.namelist()


def beside(source: Path) -> Path:
    """Where the picture of maps is, unless another file is asked for."""
    return source / "maps.png" if source.is_dir() else source.with_suffix(".png")


def draw(source: Path, path: Path) -> None:
    """Draws a map, or all maps of a folder, into a file."""
    files = sorted(source.glob("*.npz")) if source.is_dir() else [source]
    figures.save(load_map(source).plot([file.stem for file in files] or None), path)
