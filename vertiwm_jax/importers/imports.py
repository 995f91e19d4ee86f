"""Logs of other origin as a collection of drives, and what became of them."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from vertiwm_jax import atomic, froude
from vertiwm_jax import config as configuration
from vertiwm_jax.evaluation.tables import markdown
from vertiwm_jax.importers import collection, grid_map, resampling, rosbag, table, tartandrive
from vertiwm_jax.importers.log import Log
from vertiwm_jax.importers.resampling import Drive
from vertiwm_jax.importers.settings import ImportSettings
from vertiwm_jax.learning import schema
from vertiwm_jax.learning.dataset import SPLITS
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.runs import Progress
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import TerrainMap

Format = Literal["csv", "parquet", "rosbag", "tartandrive"]
READERS: dict[Format, Callable[[Path, ImportSettings], list[Log]]] = {
    "csv": table.read_csv,
    "parquet": table.read_parquet,
    "rosbag": rosbag.read,
    "tartandrive": tartandrive.read,
}
ENDINGS: dict[str, Format] = {
    ".csv": "csv",
    ".parquet": "parquet",
    ".bag": "rosbag",
    ".db3": "rosbag",
    ".mcap": "rosbag",
    ".pt": "tartandrive",
}


LARGEST_ANGLE = np.radians(20)
"""Between velocity and motion, in the median: another frame, or w before x, lie beyond."""


@dataclass(frozen=True)
class Imported:
    """What became of one source: its drives, and how many poses a second of its time it held."""

    source: Path
    drives: list[Drive]
    poses_per_second: float
    derived: tuple[str, ...]
    left_out: Counter[str]


def import_drives(
    sources: Sequence[Path],
    output: Path,
    settings_file: Path,
    *,
    format: Format | None = None,
    map: Path | None = None,
) -> str:
    """Writes logged drives as a collection, which `fit` and `evaluate` read, at 10 Hz.

    Args:
        sources: files or folders of logs, in the order in which they were driven.
        output: the folder to make.
        settings_file: YAML of `ImportSettings`.
        format: of the logs; by default as their names end.
        map: the ground, an `.npz` map; by default that of a bag's GridMap topic.

    Returns:
        What became of the logs, as text.

    Raises:
        DataError, MapError, ConfigError: a file cannot be used; the message names it.
    """
    settings = configuration.load(ImportSettings, settings_file)
    readers = [_reader(source, format) for source in sources]
    with atomic.new_folder(output) as unfinished:
        terrain, said = _terrain(sources, settings_file, settings, map)
        imported = []
        with Progress(len(sources), "logs") as progress:
            for source, read in zip(sources, readers, strict=True):
                imported.append(_import(source, read(source, settings), settings, terrain))
                progress.advance(1, source.name)
        drives = [drive for each in imported for drive in each.drives]
        if not drives:
            raise DataError(
                f"{sources[0]}: expected a drive or more that can be used, found none: "
                + "; ".join(_reasons(each) for each in imported)
            )
        meta = {"sources": [str(source) for source in sources]}
        wheels = settings.vehicle.wheels_in_body_xy
        collection.write(unfinished, drives, terrain, wheels, meta)
    remarks = _remarks(drives, terrain, settings.vehicle.scale)
    return "\n".join([_table(imported), "", *said, *remarks])


def _reader(source: Path, asked: Format | None) -> Callable[[Path, ImportSettings], list[Log]]:
    if not source.exists():
        raise DataError(f"{source}: expected a file or folder of logs, found none")
    if asked is None:
        is_bag = (source / "metadata.yaml").is_file()
        asked = "rosbag" if is_bag else ENDINGS.get(source.suffix)
    if asked is None:
        raise DataError(
            f"{source}: expected --format, as the name does not tell what it is; one of "
            + ", ".join(READERS)
        )
    return READERS[asked]


def _terrain(
    sources: Sequence[Path], settings_file: Path, settings: ImportSettings, map: Path | None
) -> tuple[TerrainMap, list[str]]:
    if map is not None:
        if map.is_dir():
            raise DataError(f"{map}: expected the .npz map of one world, found a folder")
        return files.load_map(map, scale=settings.vehicle.scale), []
    if settings.rosbag is None or settings.rosbag.grid_map is None:
        raise DataError(
            f"{settings_file}: expected ground: give `--map MAP.npz`, which terrain.files.save "
            "writes (docs/own-map.md), or name a bag's GridMap topic in rosbag.grid_map"
        )
    terrain, unknown = grid_map.terrain(sources, settings.rosbag.grid_map, settings.frames)
    terrain = froude.scaled(terrain, settings.vehicle.scale)
    return terrain, [f"{unknown:.0%} of the map had no height, and took that of the nearest cell"]


def _import(
    source: Path, logs: list[Log], settings: ImportSettings, terrain: TerrainMap
) -> Imported:
    """The drives of all logs of a source that are on the map."""
    drives, left_out = [], Counter[str]()
    point = settings.vehicle.scale * np.asarray(settings.vehicle.logged_point)
    for log in logs:
        found = resampling.resample(log, settings.resampling, point)
        left_out += found.left_out
        if found.drives:
            _check(source, found.drives)
        kept = [drive for drive in found.drives if collection.on_map(terrain, drive)]
        left_out["off the map"] += len(found.drives) - len(kept)
        drives += kept
    first, apart = logs[0], [np.diff(log.time) for log in logs]
    derived = {"velocity": first.velocity, "angular velocity": first.angular_velocity}
    return Imported(
        source=source,
        drives=drives,
        poses_per_second=settings.vehicle.scale**0.5 / float(np.median(np.concatenate(apart))),
        derived=tuple(name for name, logged in derived.items() if logged is None),
        left_out=+left_out,
    )


def _check(source: Path, drives: Sequence[Drive]) -> None:
    """Raises `DataError` unless the drives are of the schema, and move where they say."""
    schema.check(source, collection.arrays(drives))
    way_off, _ = resampling.directions(drives)
    if way_off > LARGEST_ANGLE:
        raise DataError(
            f"{source}: velocity: expected to point where the positions go, found "
            f"{np.degrees(way_off):.0f} degrees off in half of the steps; see `frames` of the "
            "settings, and the order of quaternions"
        )


def _table(imported: Sequence[Imported]) -> str:
    rows = []
    for each in imported:
        steps = sum(len(drive.control) for drive in each.drives)
        speed, derived = f"{each.poses_per_second:.1f}", ", ".join(each.derived) or "-"
        drives = f"{len(each.drives)}", f"{steps:,}"
        rows.append((str(each.source), speed, derived, *drives, _reasons(each)))
    heads = ["log", "poses a second", "from poses", "drives", "steps", "left out"]
    return markdown(heads, rows)


def _reasons(each: Imported) -> str:
    return ", ".join(f"{count} {why}" for why, count in each.left_out.items()) or "-"


def _remarks(drives: Sequence[Drive], terrain: TerrainMap, scale: float) -> list[str]:
    """Whether the settings fit, in the units of the vehicle itself."""
    low, middle, high = collection.clearance(terrain, drives) / scale
    _, axis_off = resampling.directions(drives)
    lines = [
        f"the body origin is {middle:.3g} m above the map, half of the time within {low:.3g} and "
        f"{high:.3g}: expected is about the radius of a wheel",
        f"the vehicle moves {np.degrees(axis_off):.1f} degrees off its x axis, in the median: "
        "more than 20 hint at another frame",
    ]
    lacking = [split for split, indices in SPLITS.items() if len(drives) <= indices.start]
    if lacking:
        lines.append(
            f"{len(drives)} drives are too few for {' and '.join(lacking)}: expected "
            f"{collection.PER_FILE} or more; a smaller resampling.longest makes more of them"
        )
    return lines
