"""A whole fit of the world model: its settings, `run`, and `fit` for programs."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from vertiwm_jax import config as configuration
from vertiwm_jax import xla
from vertiwm_jax.config import ConfigError, settings
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.learning import pipeline
from vertiwm_jax.learning.pipeline import PipelineConfig
from vertiwm_jax.models import files
from vertiwm_jax.models.registry import load_fitted
from vertiwm_jax.precision import float32
from vertiwm_jax.runs import Run
from vertiwm_jax.world_model.verti_wm import VertiWMParams

_log = logging.getLogger(__name__)


@settings
class FitConfig(PipelineConfig):
    """Fit Verti-WM to recorded drives: autoencoders, both specialists, the gate."""

    GONE: ClassVar[dict[str, str]] = xla.GONE

    name: str = "fit"
    """What the name of the run folder begins with; the date follows."""
    runs: Path = Path("runs")
    """Folder in which the folder of this run is made."""
    resume: Path | None = None
    """Folder of an earlier run to go on with; stages that have ended are not repeated."""
    start: Path | None = None
    """Folder of a fitted model to go on from, or the name of one that comes with the package,
    `pretrained` or `any_vehicle`: it is fitted further by open-loop predictions; its encoders and
    constants stay. It may have fewer gates than `model.gates`, and be of one vehicle where
    `model.vehicles` is any."""
    wandb: str | None = None
    """Project of Weights & Biases that gets the metrics too; needs the package `wandb`."""


def run(config: FitConfig) -> Path:
    """Fits all stages, or goes on with them; the folder of the run, with the model in `model`.

    Tells by logging what it does. Raises `UserError` where settings, drives, an earlier run or the
    disk do not allow it, and `TrainingInterrupted` at Ctrl-C once all is saved.
    """
    Run.expect(config, config.wandb)
    start = started(config)
    for collection in pipeline.expect_drives(config):
        _log.info("%s", collection)
    with Run.begin(config, config.name, project=config.wandb) as run:
        _log.info("run folder %s", run.folder)
        params = pipeline.fit(config, run, start)
        files.save(run.folder / "model", config.model, params)
    return run.folder


@float32
def fit(
    drives: str | Path | Sequence[str | Path],
    *,
    config: str | Path = "fit_chrono",
    start: str | Path | None = None,
    runs: str | Path = "runs",
    **settings: Any,
) -> tuple[Dynamics, Params]:
    """Fits Verti-WM to recorded drives.

    Progress is logged; `logging.basicConfig(level="INFO")` shows it.

    Args:
        drives: a folder of drives, as `load_drives` reads them, or several.
        config: name of shipped settings (`fit_chrono` for a new model, `fine_tune` to go
            on from the pretrained one, ...), or a YAML file of them.
        start: folder of a fitted model to go on from, or the name of one that comes with the
            package, `pretrained` or `any_vehicle`; by default what the settings say.
        runs: folder in which the folder of this run is made.
        settings: fields of the settings to change (`seed`, `vehicle`, `model`, ...).

    Returns:
        The fitted model and its parameters; they are also in the folder `model` of the run.

    Raises:
        ConfigError: a setting is unknown or refused, or `start` is of another kind of model.
        DataError, MapError: drives or their maps are malformed or too few.
    """
    chosen = configuration.load(FitConfig, configuration.find(config))
    configuration.expect_fields(settings, chosen)
    data = [drives] if isinstance(drives, str | Path) else drives
    settings |= {"data": tuple(map(Path, data)), "runs": Path(runs)}
    settings |= {"start": Path(start)} if start else {}
    found = load_fitted(run(replace(chosen, **settings)) / "model")
    return found.get("vertiwm") or next(iter(found.values()))


def started(config: FitConfig) -> VertiWMParams | None:
    """The parameters to go on from; `ConfigError` if they are of another model."""
    if config.start is None:
        return None
    found, params = files.load(files.find(config.start))
    if config.model.vehicles == "any":
        found = replace(found, vehicles="any")
    if found.gates > config.model.gates or replace(found, gates=config.model.gates) != config.model:
        raise ConfigError(f"{config.start}: expected {config.model}, found {found}")
    return params
