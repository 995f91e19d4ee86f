"""`vertiwm make_logs`: recorded drives as a vehicle would have logged them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from vertiwm_jax.cli import arguments
from vertiwm_jax.importers.noise import NoiseConfig, make_logs
from vertiwm_jax.mechanics.vehicle import HMMWV


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
    seconds, logs = make_logs(
        command.data, command.output, command.vehicle, command.noise, command.seed
    )
    made = command.output
    print(f"{seconds / 60:.1f} minutes of logs are in {made}; to import them:")
    for log in logs:
        print(
            f"python -m vertiwm_jax.import_drives {made / log}.csv --settings "
            f"{made / 'settings.yaml'} --map {made / 'maps' / log}.npz --output DRIVES/{log}"
        )
