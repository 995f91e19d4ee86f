"""`vertiwm export`: a learned policy as robots can run it."""

import tyro

from vertiwm_jax.cli import arguments
from vertiwm_jax.deploy.export import export


def run(name: str, words: list[str]) -> None:
    positional = (tyro.conf.PositionalRequiredArgs,)
    print(f"the policy is in {arguments.read(export, name, words, config=positional)}")
