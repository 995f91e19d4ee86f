"""Logs of other origin as a collection of drives, and what became of them."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from vertiwm_jax import atomic, froude
from vertiwm_jax import config as configuration
from vertiwm_jax.evaluation.tables import Row, markdown
from vertiwm_jax.importers import grid_map, resampling, rosbag, table
from vertiwm_jax.importers.log import Log
from vertiwm_jax.importers.resampling import Drive
from vertiwm_jax.importers.settings import ImportSettings
from vertiwm_jax.learning import schema
from vertiwm_jax.learning.dataset import SPLITS
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.runs import Progress
from vertiwm_jax.terrain import files, query
from vertiwm_jax.terrain.map import TerrainMap

Reader = Callable[[Path, ImportSettings], list[Log]]
READERS: dict[str, Reader] = {
    ".csv": table.read,
    ".parquet": table.read,
    ".bag": rosbag.read,
    ".db3": rosbag.read,
    ".mcap": rosbag.read,
}
"""Formats of logs, by how their names end."""
PER_FILE = SPLITS["test"].stop
"""Drives in a file. The first of them are for training, the last for tests."""
LARGEST_ANGLE = np.radians(20)
"""Between velocity and motion, in the median: another frame, or w before x, lie beyond."""


def import_drives(
    sources: Sequence[Path],
    output: Path,
    settings_file: Path,
    *,
    map: Path | None = None,
) -> str:
    """Writes logged drives as a collection, which `fit` and `evaluate` read, at 10 Hz.

    Args:
        sources: files or folders of logs, in the order in which they were driven.
        output: the folder to make.
        settings_file: YAML of `ImportSettings`.
        map: the ground, an `.npz` map; by default that of a bag's GridMap topic.

    Returns:
        What became of the logs, as text.

    Raises:
        DataError, MapError, ConfigError: a file cannot be used; the message names it.
    """
    settings = configuration.load(ImportSettings, settings_file)
    readers = [_reader(source) for source in sources]
    with atomic.new_folder(output) as unfinished:
        terrain, said = _terrain(sources, settings_file, settings, map)
        drives, rows, remarks = list[Drive](), list[Row](), list[str]()
        with Progress(len(sources), "logs") as progress:
            for source, read in zip(sources, readers, strict=True):
                logs = read(source, settings)
                remarks += [remark for log in logs for remark in log.remarks]
                found, row = _import(source, logs, settings, terrain)
                drives += found
                rows.append(row)
                progress.advance(1, source.name)
        if not drives:
            reasons = "; ".join(str(row["left out"]) for row in rows)
            raise DataError(
                f"{sources[0]}: expected a drive or more that can be used, found none: {reasons}"
            )
        (unfinished / "maps").mkdir()
        files.save(terrain, unfinished / "maps" / "map.npz")
        meta = {"sources": [str(source) for source in sources], "map": "map.npz"}
        wheels = settings.vehicle.wheels_in_body_xy
        for number, first in enumerate(range(0, len(drives), PER_FILE)):
            some = schema.in_file(_arrays(drives[first : first + PER_FILE]), terrain.offset())
            schema.write(unfinished / f"drives_{number:03d}.npz", some, meta, wheels)
    remarks += _remarks(drives, terrain, settings.vehicle.scale)
    return "\n".join([markdown(rows), "", *said, *remarks])


def _reader(source: Path) -> Reader:
    if not source.exists():
        raise DataError(f"{source}: expected a file or folder of logs, found none")
    if (source / "metadata.yaml").is_file():
        return rosbag.read
    if source.suffix not in READERS:
        endings = ", ".join(READERS)
        raise DataError(f"{source}: expected a name that ends in one of {endings}, or a ROS 2 bag")
    return READERS[source.suffix]


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
    source: Path, logs: Sequence[Log], settings: ImportSettings, terrain: TerrainMap
) -> tuple[list[Drive], Row]:
    """The drives of a source that are on the map, and its row of the table.

    Raises `DataError` unless all drives are of the schema, and move where they say.
    """
    scale = settings.vehicle.scale
    drives, left_out = list[Drive](), Counter[str]()
    point = scale * np.asarray(settings.vehicle.logged_point)
    offset = np.append(terrain.offset(), 0)
    for log in logs:
        log = replace(log, position=log.position - offset)
        found, short = resampling.resample(log, settings.resampling, point)
        drives += found
        left_out += short
    if drives:
        schema.check(source, _arrays(drives))
        way_off, axis_off = resampling.directions(drives)
        if way_off > LARGEST_ANGLE:
            raise DataError(
                f"{source}: velocity: expected to point where the positions go, found "
                f"{np.degrees(way_off):.0f} degrees off in half of the steps; see `frames` of the "
                "settings, and the order of quaternions"
            )
        if logs[0].velocity is None and axis_off > LARGEST_ANGLE:
            raise DataError(
                f"{source}: attitude: expected a vehicle that moves along its x axis, found "
                f"{np.degrees(axis_off):.0f} degrees off in half of the steps; see `units.angle` "
                "and `frames` of the settings, and the order of quaternions"
            )
    low, high = map(np.asarray, terrain.extent)
    paths = (drive.state[:, :2] for drive in drives)
    inside = [((xy >= low) & (xy <= high)).all() for xy in paths]
    kept = [drive for drive, stays in zip(drives, inside, strict=True) if stays]
    left_out["samples"] += sum(count for log in logs for count in log.remarks.values())
    left_out["off the map"] += len(drives) - len(kept)
    reasons = ", ".join(f"{count} {why}" for why, count in left_out.items() if count)
    apart = np.concatenate([np.diff(log.time) for log in logs])
    derived = {"velocity": logs[0].velocity, "angular velocity": logs[0].angular_velocity}
    return kept, {
        "log": str(source),
        "poses a second": f"{scale**0.5 / np.median(apart):.1f}" if len(apart) else "-",
        "from poses": ", ".join(name for name, logged in derived.items() if logged is None) or "-",
        "drives": len(kept),
        "steps": f"{sum(len(drive.control) for drive in kept):,}",
        "left out": reasons or "-",
    }


def _arrays(drives: Sequence[Drive]) -> dict[str, np.ndarray]:
    """All drives as arrays of the schema."""
    return schema.join([schema.drive(drive.state, drive.control) for drive in drives])


def _remarks(drives: Sequence[Drive], terrain: TerrainMap, scale: float) -> list[str]:
    """Whether the settings fit, in the units of the vehicle itself."""
    position = np.concatenate([drive.state[:, :3] for drive in drives])
    ground = query.surface(terrain, jnp.asarray(position[:, :2], jnp.float32)).height
    above = (position[:, 2] - np.asarray(ground)) / scale
    low, middle, high = np.quantile(above, [0.25, 0.5, 0.75])
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
            f"{PER_FILE} or more; a smaller resampling.longest makes more of them"
        )
    return lines
