"""`vertiwm collect`: record drives in a simulator, to fit and to test models on."""

import tyro

from vertiwm_jax.cli import arguments
from vertiwm_jax.simulators.collection import CollectConfig, collect


def run(name: str, words: list[str]) -> None:
    config = arguments.read(CollectConfig, name, words, config=(tyro.conf.FlagConversionOff,))
    collect(config)
    print(f"the drives are in {config.output}; to fit the world model to them:")
    print(f"python -m vertiwm_jax.fit --data {config.output}")
