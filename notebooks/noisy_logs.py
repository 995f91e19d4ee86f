"""Turns recorded drives into logs as a real vehicle would write them: noisy, late, with gaps.

    python notebooks/noisy_logs.py RECORDED --output LOGS --vehicle rover

writes a CSV log a world, with the maps and the settings by which `import_drives` reads them.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from vertiwm_jax import atomic, froude
from vertiwm_jax import config as configuration
from vertiwm_jax.config import Bounds, NotNegative, Positive, settings
from vertiwm_jax.errors import UserError
from vertiwm_jax.importers.settings import ImportSettings, Table, VehicleSettings
from vertiwm_jax.learning import schema
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.mechanics.vehicle import HMMWV, VehicleConfig, load
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain import files

COLUMNS = (
    "drive", "time", "x", "y", "z", "qx", "qy", "qz", "qw", "speed", "steering",
)  # fmt: skip
"""Of a table of logged drives: s, m, a quaternion, and the command that holds, m/s and rad."""
_TOLERANCE = 1e-9


@settings
class NoiseConfig:
    """Errors of a vehicle's localization, in SI units at the vehicle's own size."""

    rate: Positive = 50.0
    """Poses a second."""
    position: NotNegative = 0.001
    """m, standard deviation along each axis."""
    attitude: NotNegative = 0.005
    """rad, standard deviation about each axis."""
    latency: NotNegative = 0.02
    """s by which the stamp of a pose is late. Stamps of commands are exact."""
    dropped: Annotated[float, Bounds("at least 0 and below 1", lambda x: 0 <= x < 1)] = 0.05
    """Share of samples that are lost."""


def make_logs(
    data: Path,
    output: Path,
    vehicle: str = HMMWV,
    noise: NoiseConfig = NoiseConfig(),
    seed: int = 0,
) -> tuple[float, list[str]]:
    """Writes recorded drives as CSV logs, with their maps and the settings to import them.

    Args:
        data: folder of drives, as `collect` records them.
        output: folder to make.
        vehicle: what drove: the name of a vehicle that comes along, or a YAML file of one.
        noise: what the logs suffer from.
        seed: decides everything that is random.

    Returns:
        Seconds that the logs last, and their names without ending.
    """
    driven, rng = load(vehicle), np.random.default_rng(seed)
    sources = sorted(data.glob("*.npz"))
    if not sources:
        raise DataError(f"{data}: expected .npz files of drives, found none")
    samples = 0
    with atomic.new_folder(output) as unfinished:
        (unfinished / "maps").mkdir()
        for source in sources:
            arrays, meta = schema.read(source)
            terrain = files.load_map(schema.find_map(source, meta["map"]))
            arrays = schema.check(source, arrays, terrain.offset(), driven.turn)
            rows = []
            for number, length in enumerate(arrays["length"]):
                state = arrays["state"][number, : length + 1]
                control = arrays["control"][number, :length]
                drive = logged(state, control, driven.scale, noise, rng)
                rows.append(np.insert(drive, 0, number, axis=1))
            samples += sum(map(len, rows))
            kinds = ["%d"] + ["%.6g"] * (len(COLUMNS) - 1)
            head = {"header": ",".join(COLUMNS), "comments": ""}
            file = unfinished / f"{source.stem}.csv"
            np.savetxt(file, np.concatenate(rows), kinds, ",", **head)
            # Log and map both count positions from the middle of the map.
            small = froude.scaled(replace(terrain, middles=()), 1 / driven.scale)
            files.save(small, unfinished / "maps" / source.name)
        configuration.save(_settings(driven), unfinished / "settings.yaml")
    seconds = samples / (1 - noise.dropped) / noise.rate
    return seconds, [source.stem for source in sources]


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
    return ImportSettings(wheels, table=columns)


def logged(
    state: np.ndarray,
    control: np.ndarray,
    scale: float,
    config: NoiseConfig,
    rng: np.random.Generator,
) -> np.ndarray:
    """`[N, 10]` rows of `COLUMNS` but for the drive's number, of one drive of T steps.

    state: `[T + 1, 12]`, control: `[T, 2]`, at full size, that is `scale` times as large as the
    rows. Between its steps a drive is a cubic that has its positions and velocities, and turns
    evenly.
    """
    meter, second = scale, scale**0.5
    known = STEP_SECONDS / second * np.arange(len(state))
    rotation = Rotation.from_euler("ZYX", state[:, 5:2:-1])
    velocity = rotation.apply(state[:, 6:9]) * second / meter
    stamps = np.arange(config.latency, known[-1], 1 / config.rate)
    stamps = stamps[rng.random(len(stamps)) >= config.dropped]
    seen = stamps - config.latency
    position = CubicHermiteSpline(known, state[:, :3] / meter, velocity)(seen)
    turned = Rotation.from_rotvec(config.attitude * rng.normal(size=(len(stamps), 3)))
    step = np.minimum(
        np.searchsorted(known, stamps + _TOLERANCE, side="right") - 1, len(control) - 1
    )
    return np.column_stack(
        [
            stamps,
            position + config.position * rng.normal(size=position.shape),
            (Slerp(known, rotation)(seen) * turned).as_quat(),
            control[step] * [second / meter, 1.0],
        ]
    )


@dataclass(frozen=True)
class MakeLogs:
    """Write recorded drives as CSV logs with noise, latency and lost samples, a log a world."""

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


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes the logs, and prints how to import them."""
    asked = tyro.cli(MakeLogs, args=arguments)
    try:
        seconds, logs = make_logs(**vars(asked))
    except UserError as error:
        sys.exit(f"error: {error}")
    made = asked.output
    print(f"{seconds / 60:.1f} minutes of logs are in {made}; to import them:")
    for log in logs:
        print(
            f"python -m vertiwm_jax.import_drives {made / log}.csv --settings "
            f"{made / 'settings.yaml'} --map {made / 'maps' / log}.npz --output DRIVES/{log}"
        )


if __name__ == "__main__":
    main()
