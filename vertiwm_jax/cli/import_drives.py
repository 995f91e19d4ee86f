"""`vertiwm import_drives`: logs of other origin as drives to fit and to test on."""

from pathlib import Path
from typing import Annotated

import tyro

from vertiwm_jax.cli import arguments
from vertiwm_jax.config import AtLeastOne, settings
from vertiwm_jax.importers.imports import import_drives


@settings
class ImportDrives:
    """Bring logged drives into the form that `fit` and `evaluate` read, at 10 Hz."""

    sources: tyro.conf.Positional[Annotated[tuple[Path, ...], AtLeastOne]]
    """Files or folders of logs, in the order in which they were driven."""
    output: Path
    """Folder to make; the map is in its folder `maps`."""
    settings: Path
    """YAML file that names columns or topics, units and frames, and measures the vehicle."""
    map: Path | None = None
    """The ground, an .npz map; by default that of a bag's GridMap topic."""


def run(name: str, words: list[str]) -> None:
    command = arguments.read(ImportDrives, name, words)
    print(import_drives(command.sources, command.output, command.settings, map=command.map))
    print(
        f"the drives are in {command.output}; to predict them, beside your vehicle if you give its"
    )
    print("file (--vehicle, an HMMWV by default), and to fit the world model to them:")
    print(f"python -m vertiwm_jax.evaluate prediction --data {command.output}")
    print(f"python -m vertiwm_jax.fit --data {command.output}")
