"""`vertiwm ppo`, `sac` and `td3`: train a driving policy and show how well it drives."""

from vertiwm_jax.cli import arguments
from vertiwm_jax.evaluation import report
from vertiwm_jax.rl import experiment


def run(name: str, words: list[str]) -> None:
    config = arguments.with_file(experiment.TRAININGS[name], name, name, words)
    trained, folder, held_out = experiment.run(config)
    print(f"\n{report.after_training(trained, folder, held_out)}\n")
    print(f"all of it is in {folder}")
