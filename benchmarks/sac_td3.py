"""Transitions a second of SAC and TD3 by default, all included: collection, replay, updates.

A transition is 0.1 s of driving. The first iterations of a training only collect; measured is what
follows.
"""

from dataclasses import replace

from benchmarks._harness import Figures, parser, report
from benchmarks.ppo_throughput import iteration, training
from vertiwm_jax import config as configuration
from vertiwm_jax.models.registry import ModelName
from vertiwm_jax.rl import experiment


def of_task(name: str, model: ModelName) -> Figures:
    """An iteration of the default training by `sac` or `td3`, inside a model."""
    config = experiment.load(configuration.default_config(name))
    soon = replace(getattr(config, name), learning_starts=config.schedule.num_envs)
    config = replace(config, model=model, **{name: soon})
    return iteration(*training(config))


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--models", nargs="+", default=("builtin", "vertiwm"))
    chosen = arguments.parse_args()
    results = {
        f"{name}, {model}": of_task(name, model)
        for name in ("sac", "td3")
        for model in chosen.models
    }
    report("sac_td3", results, chosen.json)


if __name__ == "__main__":
    main()
