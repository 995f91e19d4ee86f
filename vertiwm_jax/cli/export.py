"""`vertiwm export`: a learned policy as robots can run it."""

from collections.abc import Sequence

import tyro

from vertiwm_jax.cli import arguments
from vertiwm_jax.deploy.export import export


def run(name: str, words: Sequence[str]) -> None:
    folder = arguments.read(export, name, words, config=(tyro.conf.PositionalRequiredArgs,))
    print(f"the policy is in {folder}")
