"""`python -m vertiwm_jax.evaluate`: how well a model predicts, and how well a policy drives."""

import dataclasses
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro

from vertiwm_jax import config as configuration
from vertiwm_jax import ppo, runs
from vertiwm_jax.checkpoints import CheckpointError
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.evaluation import prediction, report
from vertiwm_jax.evaluation.controllers import REFERENCE, baselines
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.windows import cut
from vertiwm_jax.mechanics.kinematic import ConstantVelocity, KinematicBicycle, bicycle_of
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import hmmwv
from vertiwm_jax.ppo import TrainConfig
from vertiwm_jax.rl import ground, task
from vertiwm_jax.runs import RunError
from vertiwm_jax.terrain.worlds import Difficulty

Model = Literal["builtin"]


@dataclass(frozen=True)
class Prediction:
    """Open-loop position errors of a model on recorded drives, beside two kinematic baselines."""

    data: Path
    """Folder of `.npz` files of drives, with the maps they name."""
    model: Model = "builtin"
    """The model."""
    split: dataset.Split = "test"
    """Which of the drives."""
    context: int = 16
    """Recorded steps that a model sees first."""
    horizon: int = 16
    """Steps that it predicts."""
    stride: int = 16
    """Steps from one window to the next."""
    json: Path | None = None
    """File to write the numbers to."""

    def __post_init__(self):
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
        numbers = _predict(command) if isinstance(command, Prediction) else _navigate(command)
        if command.json:
            runs.write_atomic(command.json, json.dumps(numbers, indent=2) + "\n")
    except (RunError, CheckpointError) as error:
        sys.exit(f"error: {error}")


def _model(name: Model) -> tuple[Dynamics, Params]:
    match name:
        case "builtin":
            return Simulator(), chrono_like(hmmwv())


def _predict(command: Prediction) -> dict[str, Any]:
    try:
        drives, terrain = dataset.load(command.data, command.split)
        windows = cut(drives, terrain, command.context, command.horizon, command.stride)
    except ValueError as error:  # what is wrong with the drives, or with their maps
        sys.exit(f"error: {error}")
    models: dict[str, tuple[Dynamics, Params]] = {
        command.model: _model(command.model),
        "kinematic bicycle": (KinematicBicycle(), bicycle_of(hmmwv())),
        "constant velocity": (ConstantVelocity(), None),
    }
    rows = [prediction.evaluate(name, *models[name], terrain, windows) for name in models]
    print(prediction.format_table(rows, command.horizon))
    return {row.name: dataclasses.asdict(row) for row in rows}


def _navigate(command: Navigation) -> dict[str, Any]:
    run = command.policy if isinstance(command.policy, Path) else None
    file = run / "config.yaml" if run else configuration.default_config("ppo")
    try:
        config = _adapted(configuration.load(TrainConfig, file), command)
        grounds, maps = config.ground, command.worlds
        terrain = ground.load(grounds, maps) if maps else task.held_out(config)
        env, test = task.test_environment(config, terrain)
    except ValueError as error:  # what is wrong with configuration, maps, or tasks on them
        sys.exit(f"error: {error}")
    policies = baselines(config.navigation)
    if run:
        policies = ppo.learned(config, env, test, run) | policies
    elif command.policy == "straight":
        policies = {REFERENCE: policies[REFERENCE]}
    groups = report.drive(env, test, policies, config.key("testing"))
    print(f"\n{report.markdown(groups, REFERENCE)}")
    return report.summary(groups, REFERENCE)


def _adapted(config: TrainConfig, command: Navigation) -> TrainConfig:
    """The configuration of a training with the ground that the command asks for."""
    grounds = replace(config.ground, pairs=command.pairs or config.ground.pairs)
    if not command.difficulties:
        return replace(config, ground=grounds)
    testing = replace(grounds.testing, difficulties=command.difficulties)
    return replace(config, worlds=None, ground=replace(grounds, testing=testing))


if __name__ == "__main__":
    main()
