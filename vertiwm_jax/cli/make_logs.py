"""`vertiwm make_logs`: recorded drives as a vehicle would have logged them."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from vertiwm_jax import atomic, froude
from vertiwm_jax import config as configuration
from vertiwm_jax.cli import arguments
from vertiwm_jax.importers import noise
from vertiwm_jax.importers.noise import NoiseConfig
from vertiwm_jax.importers.settings import ImportSettings, Resampling, Table, VehicleSettings
from vertiwm_jax.learning import schema
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.vehicle import HMMWV, VehicleConfig
from vertiwm_jax.terrain import files


@dataclass(frozen=True)
class MakeLogs:
    """Write recorded drives as CSV logs with noise, latency and lost samples, a log a world.

    Beside them are the maps and the settings that `import_drives` needs to read them.
    """

    data: tyro.conf.Positional[Path]
    """Folder of drives, as `collect` records them."""
    output: Path
    """Folder to make."""
    vehicle: str = HMMWV
    """What drove: the name of a vehicle that comes along, or a YAML file of one."""
    noise: NoiseConfig = NoiseConfig()
    """What the logs suffer from."""
    seed: int = 0
    """Decides everything that is random."""


def run(name: str, words: Sequence[str]) -> None:
    command = arguments.read(MakeLogs, name, words)
    seconds, logs = make_logs(command)
    print(f"{seconds / 60:.1f} minutes of logs are in {command.output}; to import them:")
    for log in logs:
        made = command.output
        print(
            f"python -m vertiwm_jax.import_drives {made / log}.csv --settings "
            f"{made / 'settings.yaml'} --map {made / 'maps' / log}.npz --output DRIVES/{log}"
        )


def make_logs(command: MakeLogs) -> tuple[float, list[str]]:
    """Writes the folder; s that the logs last, and their names without ending."""
    driven, rng = vehicle.load(command.vehicle), np.random.default_rng(command.seed)
    sources = sorted(command.data.glob("*.npz"))
    if not sources:
        raise DataError(f"{command.data}: expected .npz files of drives, found none")
    rows_written = 0
    with atomic.new_folder(command.output) as unfinished:
        (unfinished / "maps").mkdir()
        for source in sources:
            arrays, meta = schema.read(source)
            rows = _rows(arrays, driven.scale, command.noise, rng)
            rows_written += len(rows)
            atomic.write(unfinished / f"{source.stem}.csv", _text(rows))
            terrain = files.load_map(schema.find_map(source, meta["map"]))
            small = froude.scaled(terrain, 1 / driven.scale)
            files.save(small, unfinished / "maps" / source.name)
        configuration.save(_settings(driven), unfinished / "settings.yaml")
    kept = 1 - command.noise.dropped
    return rows_written / kept / command.noise.rate, [source.stem for source in sources]


def _rows(
    arrays: dict[str, np.ndarray], scale: float, config: NoiseConfig, rng: np.random.Generator
) -> np.ndarray:
    """`[N, 11]` of `noise.COLUMNS`, one drive after the other."""
    found = []
    for number, length in enumerate(arrays["length"]):
        state, control = arrays["state"][number, : length + 1], arrays["control"][number, :length]
        logged = noise.logged(state, control, scale, config, rng)
        found.append(np.insert(logged, 0, number, axis=1))
    return np.concatenate(found)


def _text(rows: np.ndarray) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(noise.COLUMNS)
    writer.writerows([int(row[0]), *(f"{value:.6g}" for value in row[1:])] for row in rows)
    return stream.getvalue()


def _settings(driven: VehicleConfig) -> ImportSettings:
    columns = Table(
        drive="drive",
        time="time",
        position=("x", "y", "z"),
        quaternion=("qx", "qy", "qz", "qw"),
        speed="speed",
        steering="steering",
    )
    wheels = VehicleSettings(driven.wheelbase, driven.track, scale=driven.scale)
    return ImportSettings(wheels, resampling=Resampling(), table=columns)
