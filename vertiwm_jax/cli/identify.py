"""`vertiwm identify`: numbers of a vehicle from its drives."""

from pathlib import Path
from typing import Annotated

import tyro

from vertiwm_jax import atomic
from vertiwm_jax import config as configuration
from vertiwm_jax.cli import arguments
from vertiwm_jax.config import AtLeastOne, Count, settings
from vertiwm_jax.learning import identification
from vertiwm_jax.mechanics.vehicle import HMMWV


@settings
class Identify:
    """Find numbers of a vehicle with which the built-in simulator predicts its drives best."""

    drives: tyro.conf.Positional[Annotated[tuple[Path, ...], AtLeastOne]]
    """Folders of drives, as `collect` and `import_drives` write them."""
    output: Path
    """YAML file of the vehicle to write, for `--vehicle` of other commands."""
    vehicle: str = HMMWV
    """Numbers to begin with: the name of a shipped vehicle, or a YAML file of one."""
    free: Annotated[tuple[str, ...], AtLeastOne] = identification.FREE
    """Which of its numbers to find."""
    horizon: Count = 16
    """Steps of 0.1 s that are predicted."""


def run(name: str, words: list[str]) -> None:
    command = arguments.read(Identify, name, words)
    atomic.expect_file(command.output)
    asked = {"free": command.free, "horizon": command.horizon}
    found = identification.identify(command.drives, command.vehicle, **asked)
    atomic.write(command.output, configuration.dump(found))
    print(f"the vehicle is in {command.output}; to train with it:")
    print(f"python -m vertiwm_jax.ppo --model builtin --vehicle {command.output}")
