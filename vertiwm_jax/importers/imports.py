"""Logs of other origin as a collection of drives, and what became of them."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from vertiwm_jax import atomic, froude
from vertiwm_jax import config as configuration
from vertiwm_jax.errors import needs
from vertiwm_jax.evaluation.tables import Row, markdown
from vertiwm_jax.importers import delay, grid_map, planar, resampling, rosbag, table
from vertiwm_jax.importers.delay import Delay, Response
from vertiwm_jax.importers.log import Log
from vertiwm_jax.importers.resampling import Drive
from vertiwm_jax.importers.settings import GridMapSettings, ImportSettings
from vertiwm_jax.learning import schema
from vertiwm_jax.learning.dataset import SplitConfig
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.runs import Progress
from vertiwm_jax.state import STEP_SECONDS, Turn
from vertiwm_jax.terrain import files, query
from vertiwm_jax.terrain.map import TerrainMap

Reader = Callable[[Path, ImportSettings], list[Log]]
READERS: dict[str, Reader] = {
    ".csv": table.read,
    ".parquet": table.read,
    ".bag": rosbag.read,
    ".db3": rosbag.read,
    ".mcap": rosbag.read,
    ".db3.zstd": rosbag.read,
    ".mcap.zstd": rosbag.read,
}
"""Formats of logs, by how their names end."""
LARGEST_ANGLE = np.radians(20)
"""Between velocity and motion, in the median: another frame, or w before x, lie beyond."""
LARGEST_SLIP = {"front": LARGEST_ANGLE, "skid": np.radians(30)}
"""The same between motion and the x axis; a skid-steered Warthog drifts by 17 degrees."""


def import_drives(
    sources: Sequence[Path],
    output: Path,
    settings_file: Path,
    *,
    map: Path | None = None,
) -> str:
    """Writes logged drives as a collection, which `fit` and `evaluate` read, at 10 Hz.

    Logs that cannot be used are left out, as long as they are no more than half.

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
    logs = dict(log for source in sources for log in _logs(source))
    wanted = None if settings.rosbag is None else settings.rosbag.grid_map
    for path, reader in logs.items():
        packages = ["rosbags"] * (reader is rosbag.read)
        packages += ["pyarrow"] * (path.suffix in (".parquet", ".zstd"))
        for package in packages:
            with needs(package, "logs", path):
                import_module(package)
    refused = dict[Path, str]()
    with atomic.new_folder(output) as unfinished:
        ground = None if map is None else _ground(map, settings)
        read = dict[Path, list[Log]]()
        with Progress(len(logs), "logs") as progress:
            for path, reader in logs.items():
                with _leaving_out(path, refused, len(logs)):
                    read[path] = reader(path, settings)
                flat = all(planar.is_planar(log) for log in read.get(path, ()))
                if ground is None and wanted is None and not flat:
                    raise DataError(
                        f"{settings_file}: expected ground: give `--map MAP.npz`, which "
                        "terrain.files.save writes (docs/own-map.md), or name a bag's GridMap "
                        "topic in rosbag.grid_map"
                    )
                progress.advance(1, path.name)
        remarks = [remark for path in read for log in read[path] for remark in log.remarks]
        if ground is None and wanted is not None:
            ground = _ground_of_bags(list(read), wanted, settings, remarks)
        if ground is None:
            ground = planar.plane([log for path in read for log in read[path]], settings.plane)
            remarks.append(f"there is no map: the ground is a plane of {settings.plane}")
        drives, rows, delays = list[Drive](), dict[Path, Row](), list[Delay]()
        for path in read:
            with _leaving_out(path, refused, len(logs)):
                found, rows[path], late = _import(path, read[path], settings, ground, remarks)
                drives += found
                delays += [] if late is None else [late]
        if not drives:
            reasons = "; ".join(str(row["left out"]) for row in rows.values())
            raise DataError(
                f"{sources[0]}: expected a drive or more that can be used, found none: {reasons}"
            )
        (unfinished / "maps").mkdir()
        files.save(ground, unfinished / "maps" / "map.npz")
        meta = {"sources": [str(path) for path in logs], "map": "map.npz"}
        wheels = settings.vehicle.wheels_in_body_xy
        placed = schema.in_file(_arrays(drives), ground.offset())
        schema.write(unfinished / "drives.npz", placed, meta, wheels, settings.vehicle.turn)
    remarks += [*refused.values(), *_remarks(drives, ground, settings.vehicle.scale)]
    if delays:
        remarks.append(_lateness(delays, settings.vehicle.scale**0.5))
    none = dict.fromkeys(next(iter(rows.values())), "-") | {"left out": "all"}
    table = [rows.get(path, none | {"log": str(path)}) for path in logs]
    return "\n".join([markdown(table), "", *remarks])


def _logs(source: Path) -> list[tuple[Path, Reader]]:
    """The logs in a file or folder, in the order of their names, each with what reads it."""
    if not source.exists():
        raise DataError(f"{source}: expected a file or folder of logs, found none")
    if (source / "metadata.yaml").is_file():
        return [(source, rosbag.read)]
    endings = ", ".join(READERS)
    if source.is_dir():
        inside = sorted(source.iterdir())
        bags = [path for path in inside if (path / "metadata.yaml").is_file()]
        found = [path for path in inside if path in bags or path.name.endswith(tuple(READERS))]
        if found:
            return [log for path in found for log in _logs(path)]
        raise DataError(f"{source}: expected names that end in one of {endings}, found none")
    for ending, read in READERS.items():
        if source.name.endswith(ending):
            return [(source, read)]
    raise DataError(f"{source}: expected a name that ends in one of {endings}, or a ROS 2 bag")


@contextmanager
def _leaving_out(path: Path, refused: dict[Path, str], logs: int) -> Iterator[None]:
    """Takes down why a log is refused in the context; raises it where these are more than half."""
    try:
        yield
    except DataError as error:
        refused[path] = str(error)
        if 2 * len(refused) > logs:
            first = next(iter(refused.values()))
            among = f"; {len(refused)} of {logs} logs are refused, the first by this"
            raise DataError(first + among * (logs > 1)) from error


def _ground(map: Path, settings: ImportSettings) -> TerrainMap:
    if map.is_dir():
        raise DataError(f"{map}: expected the .npz map of one world, found a folder")
    return files.load_map(map, scale=settings.vehicle.scale)


def _ground_of_bags(
    paths: Sequence[Path], wanted: GridMapSettings, settings: ImportSettings, remarks: list[str]
) -> TerrainMap:
    said = dict[str, int]()
    terrain, unknown = grid_map.terrain(paths, wanted, settings.frames, said)
    remarks += [
        *said,
        f"{unknown:.0%} of the map had no height, and took that of the nearest cell",
    ]
    return froude.scaled(terrain, settings.vehicle.scale)


def _import(
    path: Path,
    logs: Sequence[Log],
    settings: ImportSettings,
    terrain: TerrainMap,
    remarks: list[str],
) -> tuple[list[Drive], Row, Delay | None]:
    """The drives of a file that are on the map, its row of the table, and how late they obey.

    Raises `DataError` unless most of its logs are of the schema, and move where they say.
    """
    vehicle, scale = settings.vehicle, settings.vehicle.scale
    drives, left_out, refused = list[Drive](), Counter[str](), list[str]()
    responses = list[Response]()
    point = scale * np.asarray(vehicle.logged_point)
    offset = np.append(terrain.offset(), 0)
    low, high = map(np.asarray, terrain.extent)
    logs = [replace(log, position=log.position - offset) for log in logs]
    flat = [planar.is_planar(log) for log in logs]
    if any(flat):
        said = f"{path}: z, roll and pitch never change in {sum(flat)} of {len(logs)} drives"
        if vehicle.wheel_radius is None and all(log.position[:, 2].any() for log in logs):
            remarks.append(f"{said}: vehicle.wheel_radius in the settings sets them on the ground")
        else:
            remarks.append(f"{said}: they are set on the ground")
            pairs = zip(logs, flat, strict=True)
            logs = [planar.lifted(log, terrain, settings) if level else log for log, level in pairs]
    for log in logs:
        found, others = resampling.resample(log, settings.resampling, point)
        try:
            if found:
                schema.check_values(log.name, _arrays(found), turn=vehicle.turn)
        except DataError as error:
            refused.append(str(error))
            continue
        inside = [((xy.state[:, :2] >= low) & (xy.state[:, :2] <= high)).all() for xy in found]
        kept = [drive for drive, stays in zip(found, inside, strict=True) if stays]
        drives += kept
        responses += [_response(log, drive, vehicle.turn) for drive in kept]
        gone = [drive.start for drive, stays in zip(found, inside, strict=True) if not stays]
        if gone:
            others["off the map"] += gone
        for why, moments in others.items():
            if why not in left_out:
                first = min(moments) / (scale**0.5 * settings.units.time)
                remarks.append(f"{log.name}: from {first:.13g} on: {why}")
            left_out[why] += len(moments)
    if 2 * len(refused) > len(logs):
        raise DataError(refused[0])
    remarks += refused
    if drives:
        schema.check_travel(path, _arrays(drives))
        way_off, axis_off = resampling.directions(drives)
        if way_off > LARGEST_ANGLE:
            raise DataError(
                f"{path}: velocity: expected to point where the positions go, found "
                f"{np.degrees(way_off):.0f} degrees off in half of the steps; see `frames` of the "
                "settings, and the order of quaternions"
            )
        if logs[0].velocity is None and axis_off > LARGEST_SLIP[vehicle.steered]:
            raise DataError(
                f"{path}: attitude: expected a vehicle that moves along its x axis, found "
                f"{np.degrees(axis_off):.0f} degrees off in half of the steps; see `units.angle` "
                "and `frames` of the settings, and the order of quaternions"
            )
    left_out["logged drives"] += len(refused)
    left_out["samples"] += sum(count for log in logs for count in log.remarks.values())
    reasons = ", ".join(f"{count} {why}" for why, count in left_out.items() if count)
    apart = np.concatenate([np.diff(log.time) for log in logs])
    derived = {"velocity": logs[0].velocity, "angular velocity": logs[0].angular_velocity}
    # Where velocities were logged, they are as they were measured.
    window = settings.resampling.window if logs[0].velocity is None else 0.0
    late = delay.estimate(responses, window) if responses else None
    row = {
        "log": str(path),
        "poses a second": f"{scale**0.5 / np.median(apart):.1f}" if len(apart) else "-",
        "from poses": ", ".join(name for name, logged in derived.items() if logged is None) or "-",
        "drives": len(drives),
        "steps": f"{sum(len(drive.control) for drive in drives):,}",
        "delay": "-" if late is None else f"{late.seconds / scale**0.5:.2f} s",
        "left out": reasons or "-",
    }
    return drives, row, late


def _response(log: Log, drive: Drive, turn: Turn) -> Response:
    time = drive.start + STEP_SECONDS * np.arange(len(drive.state))
    speed, yaw_rate = drive.state[:, 6], drive.state[:, 11]
    return Response(time, speed, yaw_rate, log.command_time, log.command, turn)


def _arrays(drives: Sequence[Drive]) -> dict[str, np.ndarray]:
    """All drives as arrays of the schema."""
    return schema.join([schema.drive(drive.state, drive.control) for drive in drives])


def _lateness(delays: Sequence[Delay], second: float) -> str:
    """How late all logs obey, in the seconds of the vehicle itself."""
    seconds, low, high = (
        np.median([getattr(late, name) for late in delays]) / second
        for name in ("seconds", "low", "high")
    )
    lags = zip(*(late.lags for late in delays), strict=True)
    told = [
        f"{what} with a lag of {np.median(some) / second:.2f} s"
        for what, each in zip(("speeds", "yaw rates"), lags, strict=True)
        if (some := [lag for lag in each if lag is not None])
    ]
    return (
        f"commands act {seconds:.2f} s late (90 %: {low:.2f} to {high:.2f}), then "
        f"{' and '.join(told)} follow; resampling.delay takes a delay off"
    )


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
    if SplitConfig().of(len(drives)) is None:
        lines.append(
            f"{len(drives)} drives can be tested on, but are too few to fit to: a smaller "
            "resampling.longest makes more of them"
        )
    return lines
