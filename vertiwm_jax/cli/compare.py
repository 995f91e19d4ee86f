"""`vertiwm compare`: train policies in several models and test them all alike."""

from vertiwm_jax.cli import arguments
from vertiwm_jax.evaluation.compare import CompareConfig, compare


def run(name: str, words: list[str]) -> None:
    config = arguments.with_file(CompareConfig, "table3", name, words)
    print(f"\n{compare(config)}")
