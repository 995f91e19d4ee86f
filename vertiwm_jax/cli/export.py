"""`vertiwm export`: a learned policy as robots can run it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from vertiwm_jax.cli import arguments
from vertiwm_jax.deploy.export import export


@dataclass(frozen=True)
class Export:
    """Write what a run has learned as robots can run it: StableHLO, ONNX, and NumPy alone."""

    run: tyro.conf.Positional[Path]
    """Folder of a policy's training, or of a policy."""
    output: Path | None = None
    """Folder to make; `export` in that of the run by default."""
    seed: int = 0
    """Which of the policies that the run trained side by side."""


def run(name: str, words: Sequence[str]) -> None:
    folder = export(**vars(arguments.read(Export, name, words)))
    print(f"the policy is in {folder}")
