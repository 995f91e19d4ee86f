"""`vertiwm evaluate`: how well a model predicts and adapts, and a policy drives."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import jax
import tyro

from vertiwm_jax import atomic, figures
from vertiwm_jax import config as configuration
from vertiwm_jax.adaptation.soil_filter import SoilFilter
from vertiwm_jax.cli import arguments
from vertiwm_jax.config import AtLeastOne, Count, CountOrZero, settings
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.env.controllers import REFERENCE
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.suites import Suite
from vertiwm_jax.evaluation import (
    adaptation,
    calibration,
    external,
    prediction,
    prediction_report,
    report,
)
from vertiwm_jax.evaluation.external import Arena
from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.experiment import FitConfig
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.kinematic import ConstantVelocity, KinematicBicycle, bicycle_of
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import HMMWV, load_vehicle
from vertiwm_jax.models.config import SoilSource
from vertiwm_jax.models.registry import ModelName, load_fitted, load_model
from vertiwm_jax.planning.improvement import ImprovementConfig
from vertiwm_jax.planning.mppi import MPPI, MPPIConfig
from vertiwm_jax.planning.shooting import Shooting, ShootingConfig
from vertiwm_jax.rl import experiment
from vertiwm_jax.rl.experiment import TrainConfig
from vertiwm_jax.runs import Progress
from vertiwm_jax.simulators import processes
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.soil import PRESETS


@settings
class Prediction:
    """Open-loop position errors of a model on recorded drives, beside two kinematic baselines."""

    data: Path
    """Folder of `.npz` files of drives, with the maps they name."""
    models: Annotated[tuple[ModelName, ...], AtLeastOne] = (
        "vertiwm",
        "nesam",
        "transformer",
        "builtin",
    )
    """The models."""
    weights: Path | None = None
    """Folder of a fitted model, instead of the one that comes with the package."""
    vehicle: str = HMMWV
    """What the built-in simulator and the bicycle drive: the name of a vehicle that comes along, or
    a YAML file of one."""
    soil: SoilSource | None = None
    """Where the models have soils from, if not from where they had them when they were fitted."""
    compare: tuple[Path, ...] = ()
    """Run folders of `fit`, of which each part is a row, beside the paper's figures for it."""
    split: dataset.Split = "test"
    """Which of the drives."""
    context: CountOrZero = 16
    """Recorded steps that a model sees first."""
    horizon: Annotated[tuple[Count, ...], AtLeastOne] = (16,)
    """Steps that it predicts; of several numbers of steps there is a table each."""
    stride: Count = 16
    """Steps from one window to the next."""
    output: Path | None = None
    """Folder for tables and pictures, also of where and how the first model errs."""


@settings
class Adaptation:
    """Open-loop position errors where the map has soils wrong, and how they are adapted to."""

    data: Path
    """Folder of `.npz` files of drives, with the maps they name."""
    model: ModelName = "nesam"
    """The model that adapts."""
    weights: Path | None = None
    """Folder of a fitted model, instead of the one that comes with the package."""
    wrong: str = "snow"
    """What the map is made to say of all soil: a name of `terrain.soil.PRESETS`."""
    split: dataset.Split = "test"
    """Which of the drives."""
    every: Count = 1
    """Of how many drives one is used."""
    filter: SoilFilter = SoilFilter()
    """How soils are estimated."""

    def check(self):
        if self.wrong not in PRESETS:
            raise ValueError(f"wrong: expected one of {', '.join(PRESETS)}, found {self.wrong!r}")


@settings
class Calibration:
    """How far off predictions of Verti-WM are, by how much its gates or specialists disagree.

    Bounds on the error are found from the validation drives, and tried on the test drives.
    """

    data: Path
    """Folder of `.npz` files of drives, with the maps they name."""
    weights: Path | None = None
    """Folder of a fitted model, instead of the one that comes with the package."""
    context: CountOrZero = 16
    """Recorded steps that the model sees first."""
    horizon: Count = 16
    """Steps that it predicts."""
    output: Path | None = None
    """Folder for tables and a picture."""


@settings
class Navigation:
    """Success, time, roll and pitch of a policy, on worlds that it was not trained on.

    The worlds and tasks are those held out of the policy's training, unless others are asked for.
    """

    policy: Literal["straight", "random", "mppi", "shooting"] | Path
    """Folder of a training run, or what has learned nothing: a controller, or a plan in a model."""
    mppi: MPPIConfig = MPPIConfig()
    """How it plans, and in which model, whatever moves the vehicle."""
    shooting: ShootingConfig = ShootingConfig()
    """The same of planning by gradients."""
    planning: bool | None = None
    """Whether the policy of a run drives a second time, planning; by default as its run says."""
    simulator: Arena = "builtin"
    """What moves the vehicle; Chrono needs PyChrono, and moves one in each process."""
    jobs: Count = 1
    """Processes that drive, in Chrono."""
    vehicle: str | None = None
    """Name or YAML file of another vehicle than the policy's training was meant for."""
    terrain: Path | None = None
    """A Verti-Bench checkout or a folder of .npz maps, to drive on all of them."""
    obstacles: bool = False
    """Whether the rocks and trees of these maps stand there."""
    suites: tuple[Suite, ...] = ()
    """Kinds of procedural worlds; all three by default."""
    suite_worlds: Count | None = None
    """How many worlds of each suite; as many as after training by default."""
    pairs: Count | None = None
    """Tasks in a world; as many as after training by default."""
    seed: int | None = None
    """Draws other procedural worlds than those held out."""
    sensing_range: float | None = None
    """Range of sensors, m, inf to know all of the map; by default as in training."""
    output: Path | None = None
    """Folder for tables, all episodes and pictures."""

    def check(self):
        drawn = ("suites", "suite_worlds", "seed")
        found = [name for name in drawn if getattr(self, name) not in ((), None)]
        if self.terrain and found:
            raise ValueError(f"{found[0]}: is of procedural worlds, give it or terrain")
        if self.obstacles and not self.terrain:
            raise ValueError("obstacles: is of given worlds; procedural ones are a suite")
        if self.planning is not None and not isinstance(self.policy, Path):
            raise ValueError(f"planning: is of the policy of a run, found {self.policy}")
        if self.jobs > 1 and self.simulator != "chrono":
            raise ValueError(f"jobs: expected 1 in all simulators but Chrono, found {self.jobs}")


def run(name: str, words: Sequence[str]) -> None:
    kinds = Prediction | Adaptation | Calibration | Navigation
    off = (tyro.conf.FlagConversionOff,)
    command = arguments.read(kinds, name, words, description=__doc__, config=off)
    if isinstance(command, Prediction):
        _predict(command)
    elif isinstance(command, Adaptation):
        _adapt(command)
    elif isinstance(command, Calibration):
        _calibrate(command)
    else:
        _navigate(command)


def _predict(command: Prediction) -> None:
    drives, terrain = dataset.load_drives(command.data, command.split)
    longest = max(command.horizon)
    test = TestWindows.of(drives, terrain, command.context, longest, command.stride)
    driven = vehicle.load(command.vehicle).vehicle
    models: dict[str, tuple[Dynamics, Params]] = {
        **{
            name: load_model(name, command.weights, vehicle=driven, soil=command.soil)
            for name in command.models
        },
        **_compared(command.compare),
        "kinematic bicycle": (KinematicBicycle(), bicycle_of(driven)),
        "constant velocity": (ConstantVelocity(), None),
    }
    predicted = {}
    with Progress(len(models), "models") as progress:
        for name, model in models.items():
            predicted[name] = jax.block_until_ready(prediction.predict(*model, test))
            progress.advance(1, f"{name}, {len(test):,} windows")
    rows = [
        [prediction.summary(name, found.states, test, steps) for name, found in predicted.items()]
        for steps in sorted(command.horizon)
    ]
    for of_models in rows:
        print(f"\n{prediction.format_table(of_models, 'position')}", flush=True)
    if command.output:
        shown = {name: predicted[name] for name in command.models}
        prediction_report.write(command.output, rows, test, shown)


def _adapt(command: Adaptation) -> None:
    drives, terrain = dataset.load_drives(command.data, command.split)
    drives = jax.tree.map(lambda x: x[:: command.every], drives)
    index = adaptation.windows_on_soil(drives, terrain)
    model, params = load_model(command.model, command.weights, soil="map", exact_gradient=True)
    wrong = adaptation.mistaken(terrain, PRESETS[command.wrong])
    adapted = adaptation.adapt(command.filter, model, params, wrong, drives)
    found = adaptation.errors(model, params, terrain, wrong, adapted, drives, index)
    print(f"\n{adaptation.format_errors(found)}")
    rows = adaptation.recovery(chrono_like(load_vehicle()), terrain, wrong, adapted)
    print(f"\n{adaptation.format_rows(rows)}" if rows else "\nno soil was driven on for long")


def _calibrate(command: Calibration) -> None:
    lengths = command.context, command.horizon, command.horizon
    measured, tested = (
        TestWindows.of(*dataset.load_drives(command.data, split), *lengths)
        for split in ("validation", "test")
    )
    model = load_model("vertiwm", command.weights)
    before, known = calibration.signs(*model, measured)
    errors, found = calibration.signs(*model, tested)
    measure, (best, order) = calibration.Calibration.measure, next(iter(found.items()))
    bounds = {name: measure(before, each) for name, each in known.items()}
    nothing = measure(before, None)
    rows = {
        **{name: calibration.coverage(bounds[name], errors, found[name], order) for name in bounds},
        "nothing": calibration.coverage(nothing, errors, order, order),
    }
    tables = [calibration.format_parts(errors, order), calibration.format_coverage(rows)]
    print("\n" + "\n\n".join(tables))
    if command.output:
        command.output.mkdir(parents=True, exist_ok=True)
        atomic.write(command.output / "calibration.md", "\n\n".join(tables) + "\n")
        figure = calibration.picture(bounds[best], errors, order, nothing)
        figures.save(figure, command.output / "calibration.png")


def _compared(folders: Sequence[Path]) -> dict[str, tuple[Dynamics, Params]]:
    """Every model that was fitted in these runs; a name that two of them have gets the folder's."""
    names = [configuration.load(FitConfig, folder / "config.yaml").name for folder in folders]
    return {
        f"{name if names.count(name) == 1 else folder.name}: {part}": model
        for name, folder in zip(names, folders, strict=True)
        for part, model in load_fitted(folder / "model").items()
    }


def _navigate(command: Navigation) -> None:
    run = command.policy if isinstance(command.policy, Path) else None
    file = run / "config.yaml" if run else configuration.default_config("ppo")
    trained = experiment.load(file)
    config = _adapted(trained, command)
    external.expect(command.simulator, config)
    maps, scale = command.terrain, config.driven.scale
    if maps:
        terrain = files.load_map(maps, scale=scale, obstacles=config.ground.obstacles)
    else:
        terrain = experiment.held_out(config)
    test = external.test_in(command.simulator, config, terrain)
    policies = config.baselines
    if run:
        # It plans as it was trained, also where it knows less of the map.
        own = replace(config, navigation=trained.navigation)
        policies = experiment.learned(own, run) | policies
    elif command.policy == "mppi":
        dynamics, weights = experiment.dynamics(config, command.mppi.model)
        env = NavigationEnv(dynamics, config.navigation)
        policies = {"mppi": MPPI(env=env, dynamics=weights, config=command.mppi)} | policies
    elif command.policy == "shooting":
        dynamics, weights = experiment.dynamics(config, command.shooting.model, exact_gradient=True)
        env = NavigationEnv(dynamics, config.navigation)
        shooting = Shooting(env=env, dynamics=weights, config=command.shooting)
        policies = {"shooting": shooting} | policies
    elif command.policy == "straight":
        policies = {REFERENCE: policies[REFERENCE]}
    with processes.simulating(command.jobs) as mapped:
        judge = external.judge_in(command.simulator, config, terrain, mapped)
        key = config.key("testing")
        groups = report.drive(test.env, test.params, policies, key, config.world_suites, judge)
    print(f"\n{report.markdown(groups, REFERENCE)}")
    if command.output:
        radius = config.navigation.goal_radius
        report.write(command.output, groups, REFERENCE, terrain, radius)


def _adapted(config: TrainConfig, command: Navigation) -> TrainConfig:
    """The configuration of a training with the test that the command asks for."""
    asked = {name: getattr(command, name) for name in ("suites", "suite_worlds", "pairs")}
    grounds = replace(config.ground, **{name: value for name, value in asked.items() if value})
    if command.terrain:
        grounds = replace(grounds, obstacles=command.obstacles)
        config = replace(config, terrain=command.terrain)
    if command.vehicle is not None:
        config = replace(config, vehicle=command.vehicle)
    if command.sensing_range is not None:
        sensing = replace(config.navigation.sensing, range=command.sensing_range)
        config = replace(config, navigation=replace(config.navigation, sensing=sensing))
    if command.planning is not None:
        planning = config.planning or ImprovementConfig()
        config = replace(config, planning=planning if command.planning else None)
    if command.suites:
        config = replace(config, terrain=None)
    if command.seed is not None:
        config = replace(config, terrain=None, seed=command.seed)
    return replace(config, ground=grounds)
