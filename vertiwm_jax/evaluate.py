"""`python -m vertiwm_jax.evaluate`: how well a model predicts, and how well a policy drives."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro

from vertiwm_jax import config as configuration
from vertiwm_jax import policy_training, runs
from vertiwm_jax.checkpoints import CheckpointError
from vertiwm_jax.config import ConfigError
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.evaluation import prediction, prediction_report, report
from vertiwm_jax.evaluation.controllers import REFERENCE, baselines
from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.fit import FitConfig
from vertiwm_jax.learning import dataset
from vertiwm_jax.mechanics.kinematic import ConstantVelocity, KinematicBicycle, bicycle_of
from vertiwm_jax.mechanics.vehicle import hmmwv
from vertiwm_jax.policy_training import TrainConfig
from vertiwm_jax.ppo import PPOTraining
from vertiwm_jax.rl import ground, task
from vertiwm_jax.runs import RunError
from vertiwm_jax.sac import SACTraining
from vertiwm_jax.td3 import TD3Training
from vertiwm_jax.terrain.worlds import Difficulty
from vertiwm_jax.world_model.choice import ModelName, choose, fitted
from vertiwm_jax.world_model.nesam import SoilSource


@dataclass(frozen=True)
class Prediction:
    """Open-loop position errors of a model on recorded drives, beside two kinematic baselines."""

    data: Path
    """Folder of `.npz` files of drives, with the maps they name."""
    models: tuple[ModelName, ...] = ("vertiwm", "nesam", "transformer", "builtin")
    """The models."""
    weights: Path | None = None
    """Folder of a fitted model, instead of the one that comes with the package."""
    soil: SoilSource | None = None
    """Where the models have soils from, if not from where they had them when they were fitted."""
    compare: tuple[Path, ...] = ()
    """Run folders of `fit`, of which each part is a row, beside the paper's figures for it."""
    split: dataset.Split = "test"
    """Which of the drives."""
    context: int = 16
    """Recorded steps that a model sees first."""
    horizon: int = 16
    """Steps that it predicts."""
    stride: int = 16
    """Steps from one window to the next."""
    output: Path | None = None
    """Folder for tables and pictures, also of where and how the first model errs."""

    def __post_init__(self):
        if not self.models:
            raise ValueError("models: expected at least one, found none")
        for name, least in (("context", 0), ("horizon", 1), ("stride", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected at least {least}, found {getattr(self, name)}")


@dataclass(frozen=True)
class Navigation:
    """Success, time, roll and pitch of a policy, on worlds that it was not trained on.

    The worlds are those held out of the policy's training, unless others are asked for.
    """

    policy: Literal["straight", "random"] | Path
    """Folder of a training run, or a controller that has learned nothing."""
    worlds: Path | None = None
    """A Verti-Bench checkout or a folder of .npz maps, to drive on all of them."""
    difficulties: tuple[Difficulty, ...] = ()
    """Draws new procedural worlds of these difficulties."""
    pairs: int | None = None
    """Tasks in a world; as many as after training by default."""
    json: Path | None = None
    """File to write the numbers to."""

    def __post_init__(self):
        if self.worlds and self.difficulties:
            raise ValueError("difficulties: are drawn, give them or worlds")


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; expected failures end in one line and a status that is not 0."""
    command = tyro.cli(
        Prediction | Navigation,
        args=argv,
        prog="python -m vertiwm_jax.evaluate",
        description=__doc__,
        config=(tyro.conf.FlagConversionOff,),
    )
    try:
        _predict(command) if isinstance(command, Prediction) else _navigate(command)
    except (RunError, CheckpointError, ConfigError, OSError) as error:
        sys.exit(f"error: {error}")


def _predict(command: Prediction) -> None:
    try:
        drives, terrain = dataset.load(command.data, command.split)
        lengths = command.context, command.horizon, command.stride
        test = TestWindows.of(drives, terrain, *lengths)
    except ValueError as error:  # what is wrong with the drives, or with their maps
        sys.exit(f"error: {error}")
    models: dict[str, tuple[Dynamics, Params]] = {
        **{name: choose(name, command.weights, command.soil) for name in command.models},
        **_compared(command.compare),
        "kinematic bicycle": (KinematicBicycle(), bicycle_of(hmmwv())),
        "constant velocity": (ConstantVelocity(), None),
    }
    rows = [prediction.evaluate(name, *models[name], test) for name in models]
    print(f"\n{prediction.format_table(rows, 'position', command.horizon)}", flush=True)
    if command.output:
        shown = {name: models[name] for name in command.models}
        prediction_report.write(command.output, rows, test, shown)


def _compared(folders: Sequence[Path]) -> dict[str, tuple[Dynamics, Params]]:
    """Every model that was fitted in these runs; a name that two of them have gets the folder's."""
    names = [configuration.load(FitConfig, folder / "config.yaml").name for folder in folders]
    return {
        f"{name if names.count(name) == 1 else folder.name}: {part}": model
        for name, folder in zip(names, folders, strict=True)
        for part, model in fitted(folder / "model").items()
    }


def _navigate(command: Navigation) -> None:
    run = command.policy if isinstance(command.policy, Path) else None
    file = run / "config.yaml" if run else configuration.default_config("ppo")
    try:
        config = _adapted(training(file), command)
        grounds, maps = config.ground, command.worlds
        terrain = ground.load(grounds, maps) if maps else task.held_out(config)
        test = task.test_environment(config, terrain)
    except ValueError as error:  # what is wrong with configuration, maps, or tasks on them
        sys.exit(f"error: {error}")
    policies = baselines(config.navigation)
    if run:
        policies = policy_training.learned(config, terrain, run) | policies
    elif command.policy == "straight":
        policies = {REFERENCE: policies[REFERENCE]}
    groups = report.drive(test.env, test.params, policies, config.key("testing"))
    print(f"\n{report.markdown(groups, REFERENCE)}")
    if command.json:
        numbers = json.dumps(report.summary(groups, REFERENCE), indent=2)
        runs.write_atomic(command.json, numbers + "\n")


def training(file: Path) -> TrainConfig:
    """The configuration of a training, by the algorithm whose settings are in the file."""
    text = file.read_text(encoding="utf-8") if file.is_file() else ""
    kinds = (PPOTraining, SACTraining, TD3Training)
    named = [kind for kind in kinds if f"\n{kind.name}:" in f"\n{text}"]
    return configuration.load(named[0] if named else PPOTraining, file)


def _adapted(config: TrainConfig, command: Navigation) -> TrainConfig:
    """The configuration of a training with the ground that the command asks for."""
    grounds = replace(config.ground, pairs=command.pairs or config.ground.pairs)
    if not command.difficulties:
        return replace(config, ground=grounds)
    testing = replace(grounds.testing, difficulties=command.difficulties)
    return replace(config, worlds=None, ground=replace(grounds, testing=testing))


if __name__ == "__main__":
    main()
