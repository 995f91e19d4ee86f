"""`vertiwm fit`: fit Verti-WM to recorded drives, all stages of it."""

import shlex

from vertiwm_jax import figures, runs
from vertiwm_jax.cli import arguments
from vertiwm_jax.evaluation import plots
from vertiwm_jax.learning import experiment, pipeline
from vertiwm_jax.learning.dataset import FITTED
from vertiwm_jax.learning.experiment import FitConfig

ROLLOUTS = ("nesam_rollouts", "transformer_rollouts", "gate*")
"""Stages that are drawn, of all gates."""
CURVES = {
    "loss": "loss",
    "error_rigid": "error on rigid ground [m]",
    "error_deformable": "error on soil [m]",
    "error_transition": "error across borders [m]",
}


def run(name: str, words: list[str]) -> None:
    config = arguments.with_file(FitConfig, "fit_chrono", name, words)
    folder = experiment.run(config)
    stages = [found.name for name in ROLLOUTS for found in sorted(folder.glob(name))]
    curves = {name: runs.read_columns(folder / name) for name in stages}
    figure = plots.learning_curves(curves, "updates", CURVES)
    figures.save(figure, folder / "learning_curves.png")
    print(f"the model is in {folder / 'model'}; how well it predicts:")
    data, splits = pipeline.folders(config, pipeline.KINDS)[0], config.splits
    shared = f" --splits.shares {' '.join(map(str, splits.shares))} --splits.whole {splits.whole}"
    shared += f" --splits.leave-out {shlex.join(splits.leave_out)}"
    also = "" if splits == FITTED else shared
    print(f"python -m vertiwm_jax.evaluate prediction --compare {folder} --data {data}{also}")
