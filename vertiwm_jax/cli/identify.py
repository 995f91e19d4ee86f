"""`vertiwm identify`: numbers of a vehicle from its drives."""

from pathlib import Path

import tyro

from vertiwm_jax import atomic
from vertiwm_jax import config as configuration
from vertiwm_jax.cli import arguments
from vertiwm_jax.learning import identification
from vertiwm_jax.mechanics.vehicle import HMMWV


def run(name: str, words: list[str]) -> None:
    arguments.read(identify, name, words)


def identify(
    drives: tyro.conf.Positional[tuple[Path, ...]],
    output: Path,
    vehicle: str = HMMWV,
    free: tuple[str, ...] = identification.FREE,
    horizon: int = 16,
) -> None:
    """Find numbers of a vehicle with which the built-in simulator predicts its drives best.

    Args:
        drives: Folders of drives, as `collect` and `import_drives` write them.
        output: YAML file of the vehicle to write, for `--vehicle` of other commands.
        vehicle: Numbers to begin with: the name of a shipped vehicle, or a YAML file of
            one.
        free: Which of its numbers to find.
        horizon: Steps of 0.1 s that are predicted.
    """
    found = identification.identify(drives, vehicle, free=free, horizon=horizon)
    atomic.write(output, configuration.dump(found))
    print(f"the vehicle is in {output}; to train with it:")
    print(f"python -m vertiwm_jax.ppo --model builtin --vehicle {output}")
