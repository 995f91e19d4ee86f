"""`vertiwm fit`: fit Verti-WM to recorded drives, all stages of it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax

from vertiwm_jax import runs
from vertiwm_jax.cli import arguments
from vertiwm_jax.config import ConfigError, settings
from vertiwm_jax.evaluation import plots
from vertiwm_jax.learning import pipeline
from vertiwm_jax.learning.pipeline import PipelineConfig
from vertiwm_jax.runs import Run
from vertiwm_jax.training import keep_compiled
from vertiwm_jax.world_model import model
from vertiwm_jax.world_model.model import VertiWMParams

ROLLOUTS = ("nesam_rollouts", "transformer_rollouts", "gate*")
"""Stages that are drawn, of all gates."""
CURVES = {
    "loss": "loss",
    "error_rigid": "error on rigid ground [m]",
    "error_deformable": "error on soil [m]",
    "error_transition": "error across borders [m]",
}


@settings
class FitConfig(PipelineConfig):
    """Fit Verti-WM to recorded drives: autoencoders, both specialists, the gate."""

    data: tuple[Path, ...] = (Path("data/open"),)
    """Folders of drives, or of such folders named rigid, deformable and mixed."""
    add: tuple[Path, ...] = ()
    """Folders of more drives beside those, such as a policy has driven (`collect --policy`)."""
    name: str = "fit"
    """What the name of the run folder begins with; the date follows."""
    seed: int = 0
    """Decides everything that is random."""
    runs: Path = Path("runs")
    """Folder in which the folder of this run is made."""
    resume: Path | None = None
    """Folder of an earlier run to go on with; stages that have ended are not repeated."""
    reuse: tuple[Path, ...] = ()
    """Folders of earlier runs, whose stages are taken over where their inputs are the same."""
    start: Path | None = None
    """Folder of a fitted model to go on from, or `pretrained`: it is fitted further by open-loop
    predictions; its encoders and constants stay. It may have fewer gates than `model.gates`."""
    wandb: str | None = None
    """Project of Weights & Biases that gets the metrics too; needs the package `wandb`."""
    compile_cache: Path | None = None
    """Folder that keeps compiled programs for later runs."""


def run(name: str, words: Sequence[str]) -> None:
    config = arguments.resumable(FitConfig, "fit_chrono", name, words)
    keep_compiled(config.compile_cache)
    start = _start(config)
    with Run.begin(config, config.name, project=config.wandb) as run:
        print(f"run folder {run.folder}", flush=True)
        key = jax.random.key(config.seed)
        folders = config.data + config.add
        params = pipeline.fit(config, folders, key, run, config.reuse, start)
        model.save(run.folder / "model", config.model, params)
        _draw(run)
    print(f"the model is in {run.folder / 'model'}; how well it predicts:")
    data = config.data[0]
    print(f"python -m vertiwm_jax.evaluate prediction --compare {run.folder} --data {data}")


def _start(config: FitConfig) -> VertiWMParams | None:
    """The parameters to go on from; `ConfigError` if they are of another model."""
    if config.start is None:
        return None
    pretrained = config.start == Path("pretrained")
    found, params = model.load(model.PRETRAINED if pretrained else config.start)
    if found.gates > config.model.gates or replace(found, gates=config.model.gates) != config.model:
        raise ConfigError(f"{config.start}: expected {config.model}, found {found}")
    return params


def _draw(run: Run) -> None:
    """Losses and errors on validation drives of the stages that learn from rollouts."""
    stages = [found.name for name in ROLLOUTS for found in sorted(run.folder.glob(name))]
    curves = {name: runs.read_columns(run.folder / name) for name in stages}
    figure = plots.learning_curves(curves, "updates", CURVES, "updates")
    plots.save(figure, run.folder / "learning_curves.png")
