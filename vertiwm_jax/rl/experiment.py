"""Driving policies as what is learned: the settings of a training, its environments, and `run`."""

import logging
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, cast

import jax

from vertiwm_jax import config as configuration
from vertiwm_jax import machine, training, xla
from vertiwm_jax.config import Count, CountOrZero
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.env import controllers, suites
from vertiwm_jax.env.agent import Agent, Policy
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.randomization import RandomizationConfig
from vertiwm_jax.env.suites import GroundConfig, Suite, Tasks
from vertiwm_jax.env.task import NavigationConfig, TaskParams
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import HMMWV, VehicleConfig
from vertiwm_jax.models import files
from vertiwm_jax.models.registry import Imagined, ModelName, load_encoders, load_model
from vertiwm_jax.networks.specialist import ComputeDtype
from vertiwm_jax.perception.features import Encoders
from vertiwm_jax.planning.improvement import ImprovementConfig, PolicyImprovement
from vertiwm_jax.precision import float32
from vertiwm_jax.rl import policy
from vertiwm_jax.rl.algorithm import LearningConfig, PolicyAlgorithm
from vertiwm_jax.rl.policy import Base, PolicyConfig, load_policy
from vertiwm_jax.rl.ppo import PPO, PPOConfig
from vertiwm_jax.rl.sac import SAC, SACConfig
from vertiwm_jax.rl.td3 import TD3, TD3Config
from vertiwm_jax.runs import Run
from vertiwm_jax.terrain.map import TerrainMap, expect_room
from vertiwm_jax.training import LoopConfig, Seeds, Work

Rows = dict[str, Policy | Agent]
"""Policies by their names in tables."""
_log = logging.getLogger(__name__)


@configuration.settings
class TaskConfig:
    """What is driven, where, and with what."""

    GONE: ClassVar[dict[str, str]] = {
        "worlds": "is now terrain",
        "operands": "is now compute_dtype",
        **xla.GONE,
    }

    seed: CountOrZero = 0
    """Decides everything that is random."""
    vehicle: str = HMMWV
    """What drives: the name of a shipped vehicle, or a YAML file of one. Models that were fitted
    to one vehicle drive that."""
    terrain: Path | None = None
    """A Verti-Bench checkout or a folder of .npz maps; procedural worlds by default."""
    ground: GroundConfig = GroundConfig()
    """What worlds and tasks."""
    navigation: NavigationConfig = NavigationConfig()
    """What the task is."""
    variation: RandomizationConfig = RandomizationConfig()
    """How episodes differ from what map and model say, while learning."""
    model: ModelName = "vertiwm"
    """What moves the vehicle while learning; tests after it are in the built-in simulator."""
    weights: Path | None = None
    """Folder of a fitted model, instead of one that comes with the package, of which the HMMWV has
    its own; or the name of that, `pretrained` or `any_vehicle`."""
    compute_dtype: ComputeDtype | Literal["auto"] = "auto"
    """Precision in which learned models multiply large matrices. bfloat16 is faster on CPUs with
    AVX512_BF16 and slower on others; prediction errors change by less than 1 %. A training that
    begins with auto measures which one is faster, and keeps it."""
    simulator: Simulator = Simulator()
    """The built-in simulator."""

    def check(self):
        driven = self.driven.vehicle  # That it cannot be read is to be said now.
        fastest, asked = float(driven.fastest), max(map(abs, self.navigation.speed_range))
        if driven.skid is not None and asked > fastest:
            raise ValueError(
                f"navigation.speed_range: expected at most {fastest:.3g} m/s at full size, as "
                f"{self.vehicle} cannot turn where both sides are at their limit, found {asked:g}"
            )

    @property
    def fixed_dtype(self) -> ComputeDtype:
        """`compute_dtype`, or the one that is faster here."""
        if self.compute_dtype == "auto":
            return "bfloat16" if machine.multiplies_bfloat16() else "float32"
        return self.compute_dtype

    @property
    def driven(self) -> VehicleConfig:
        """The vehicle; `ConfigError` if there is no such."""
        return vehicle.load(self.vehicle)

    @property
    def world_suites(self) -> list[Suite] | None:
        """The suite of each world that is held out; None of given maps."""
        return None if self.terrain else self.ground.world_suites

    @property
    def baselines(self) -> dict[str, Policy]:
        """The controllers that policies are compared with and may correct."""
        return controllers.baselines(self.navigation, self.driven.vehicle)

    def key(self, purpose: Literal["worlds", "tasks", "training", "testing"]) -> jax.Array:
        """The random key of one purpose."""
        number = ("worlds", "tasks", "training", "testing").index(purpose)
        return jax.random.fold_in(jax.random.key(self.seed), number)


@configuration.settings
class TrainConfig(TaskConfig):
    """Settings of every training.

    kind: its algorithm; name: that of the algorithm's settings among these.
    """

    name: ClassVar[str]
    kind: ClassVar[type[PolicyAlgorithm[Any]]]

    runs: Path = Path("runs")
    """Folder in which the folder of this run is made."""
    resume: Path | None = None
    """Folder of an earlier run to go on with; what is set beside changes its configuration."""
    wandb: str | None = None
    """Project of Weights & Biases that gets the metrics too; needs the package `wandb`."""
    action_repeat: Count = 8
    """Steps of 0.1 s that an action is held while learning."""
    base: Base = "look ahead"
    """The controller that the policy learns to correct; it acts at every step."""
    planning: ImprovementConfig | None = None
    """How the policy plans in tests, besides driving as it is; learning does not need it."""
    loop: LoopConfig = LoopConfig()
    """Seeds and checkpoints."""

    def check(self):
        super().check()
        if self.base == "look ahead" and not self.navigation.arcs:
            raise ValueError(
                "base: expected straight to goal or none, as navigation.arcs is false, found "
                + self.base
            )

    @property
    def schedule(self) -> LearningConfig:
        """The algorithm's settings."""
        return getattr(self, self.name)

    def algorithm(self, env: NavigationEnv) -> PolicyAlgorithm[Any]:
        """The algorithm on the task, as configured."""
        repeated = replace(env, action_repeat=self.action_repeat, base=self.controller)
        return self.kind(repeated, self.schedule, outcomes, env.config.observed.layout)

    @property
    def controller(self) -> Policy | None:
        """What the policy corrects."""
        return self.baselines.get(self.base)

    @property
    def of_policy(self) -> PolicyConfig:
        """What is kept beside what it learns."""
        return PolicyConfig(
            algorithm=cast(Any, self.name),
            hidden=self.schedule.hidden,
            initial_log_std=getattr(self.schedule, "initial_log_std", None),
            navigation=self.navigation,
            base=self.base,
            action_repeat=self.action_repeat,
            discount=self.schedule.discount,
            vehicle=self.driven,
            model=self.model,
            weights=self.weights,
            seeds=self.loop.seeds,
        )


@configuration.settings
class PPOTraining(TrainConfig):
    """Train an off-road driving policy by PPO inside a model of the vehicle."""

    name: ClassVar[str] = "ppo"
    kind: ClassVar[type[PolicyAlgorithm[Any]]] = PPO
    navigation: NavigationConfig = NavigationConfig(speed_range=(-3.0, 5.0))
    """What the task is; the vehicle may back up where it is stuck."""
    ppo: PPOConfig = PPOConfig()
    """The algorithm."""


@configuration.settings
class SACTraining(TrainConfig):
    """Train an off-road driving policy by SAC inside a model of the vehicle."""

    name: ClassVar[str] = "sac"
    kind: ClassVar[type[PolicyAlgorithm[Any]]] = SAC
    sac: SACConfig = SACConfig()
    """The algorithm."""


@configuration.settings
class TD3Training(TrainConfig):
    """Train an off-road driving policy by TD3 inside a model of the vehicle."""

    name: ClassVar[str] = "td3"
    kind: ClassVar[type[PolicyAlgorithm[Any]]] = TD3
    td3: TD3Config = TD3Config()
    """The algorithm."""


TRAININGS: dict[str, type[TrainConfig]] = {
    kind.name: kind for kind in (PPOTraining, SACTraining, TD3Training)
}


def load(file: Path) -> TrainConfig:
    """The settings of a training, by the algorithm whose settings are in the file."""
    text = file.read_text(encoding="utf-8") if file.is_file() else ""
    named = [kind for name, kind in TRAININGS.items() if f"\n{name}:" in f"\n{text}"]
    return configuration.load(named[0] if named else PPOTraining, file)


def training_ground(
    config: TaskConfig, worlds: TerrainMap | None = None
) -> tuple[TerrainMap, Tasks, TerrainMap]:
    """The worlds to train on, tasks on them, and the worlds held out for tests.

    worlds: to train and to test on, in place of those of the configuration. Raises `MapError` or
    `TaskError` where maps, or tasks on them, cannot be used.
    """
    navigation, driven = config.navigation, config.driven
    asked = config.ground, config.terrain, config.key("worlds"), driven.scale
    terrain, held_out = (worlds, worlds) if worlds else suites.grounds(*asked)
    expect_room(terrain, suites.SMALLEST, "map" if worlds else str(config.terrain))
    # Now, and not when the training is over.
    tests = suites.test_tasks(config.ground, held_out)
    suites.validate(tests, held_out, navigation.goal_radius, navigation.map_margin)
    pool = suites.training_tasks(config.ground, terrain, driven.vehicle, config.key("tasks"))
    return terrain, pool, held_out


def held_out(config: TaskConfig) -> TerrainMap:
    """The worlds that a training holds out."""
    key, scale = config.key("worlds"), config.driven.scale
    if config.terrain is None:
        return suites.suite_worlds(config.ground, key, scale)
    terrain = suites.grounds(config.ground, config.terrain, key, scale)[1]
    expect_room(terrain, suites.SMALLEST, str(config.terrain))
    return terrain


def environment(
    config: TaskConfig,
    model: ModelName,
    terrain: TerrainMap,
    pool: Tasks,
    variation: RandomizationConfig = RandomizationConfig(),
) -> tuple[NavigationEnv, TaskParams]:
    """Tasks inside one of the models; weights that cannot be read raise `CheckpointError`."""
    moves, params = dynamics(config, model)
    env = env_of(config, model, moves, variation)
    return env, env.make_params(params, terrain, pool, config.driven.vehicle, encoders(config))


def env_of(
    config: TaskConfig, model: ModelName, moves: Dynamics, variation: RandomizationConfig
) -> NavigationEnv:
    """The tasks of `environment` without parameters, where the model has been loaded as `moves`."""
    settling = None if model == "builtin" else replace(config.simulator, ruts=False)
    return NavigationEnv(moves, config.navigation, variation, settling=settling)


def dynamics(
    config: TaskConfig, model: Imagined, exact_gradient: bool = False
) -> tuple[Dynamics, Params]:
    """One of the models, and its parameters."""
    if model == "builtin":
        return config.simulator, chrono_like(config.driven.vehicle)
    return load_model(
        model,
        config.weights,
        vehicle=config.driven.vehicle,
        embeddings=config.navigation.embeddings,
        compute_dtype=config.fixed_dtype,
        exact_gradient=exact_gradient,
        ruts=config.simulator.ruts,
    )


def encoders(config: TaskConfig) -> Encoders | None:
    """By which policies see the ground, if they see it."""
    return load_encoders(config.weights) if config.navigation.embeddings else None


def outcomes(info: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """What is reported of an episode's last step."""
    ending = info["ending"]
    return {
        "success": ending == TerminationReason.GOAL,
        "timed_out": ending == TerminationReason.TIMED_OUT,
        "final_distance": info["distance"],
    }


def run(
    config: TrainConfig, worlds: TerrainMap | None = None
) -> tuple[TrainConfig, Path, TerrainMap]:
    """Trains, or goes on with, the policies of one training; worlds: as in `training_ground`.

    Gives the settings as they were trained with, the folder of the run, and the worlds held out.
    Tells by logging what it does. Raises `UserError` where settings, maps, tasks, an earlier run or
    the disk do not allow it, and `TrainingInterrupted` at Ctrl-C once all is saved.
    """
    Run.expect(config, config.wandb)
    # So that it goes on as it began, and is tested, from wherever that is. Models that come along
    # keep their names, as packages may be moved.
    own = config.weights and files.find(config.weights) == config.weights
    paths = {"terrain": config.terrain, "weights": config.weights if own else None}
    absolute = {name: path.absolute() for name, path in paths.items() if path}
    config = replace(config, compute_dtype=config.fixed_dtype, **absolute)
    moves, weights = dynamics(config, config.model)
    _log.info("drawing worlds ...")
    terrain, pool, held_out = training_ground(config, worlds)
    machine.forget_programs()
    env = env_of(config, config.model, moves, config.variation)
    algorithm = config.algorithm(env)
    seeds = Seeds(algorithm, config.loop.seeds)
    _log.info("placing vehicles for %s tasks ...", f"{len(pool.world):,}")
    params = env.make_params(weights, terrain, pool, config.driven.vehicle, encoders(config))
    machine.forget_programs()
    restored = training.restore(seeds, params, config.resume) if config.resume else None
    with Run.begin(config, config.name, restored[0] if restored else 0, config.wandb) as begun:
        _log.info("run folder %s", begun.folder)
        products = "" if config.model == "builtin" else f", multiplying {config.compute_dtype}"
        _log.info("training in %s on %d worlds%s", config.model, terrain.worlds, products)

        def keep(state: Any) -> None:
            value = algorithm.value(state)
            policy.save(begun.folder / policy.FOLDER, config.of_policy, value)

        steps = algorithm.timesteps * config.loop.seeds
        work = Work("timesteps", steps, ("episode_return", "success"))
        key, iterations = config.key("training"), algorithm.iterations
        state = training.train(
            seeds, params, key, begun, iterations, work, config.loop, restored, keep
        )
        keep(state)
    return config, begun.folder, held_out


@float32
def train(
    config: str | Path = "ppo",
    terrain: TerrainMap | str | Path | None = None,
    *,
    runs: str | Path = "runs",
    resume: str | Path | None = None,
    **settings: Any,
) -> policy.Policy:
    """Trains a driving policy inside a model of the vehicle.

    Progress is logged; `logging.basicConfig(level="INFO")` shows it.

    Args:
        config: name of shipped settings (`ppo`, `sac`, `td3`, `ppo_small`, ...), or a YAML
            file of them.
        terrain: the worlds to train on, or a path to maps; procedural ones by default.
        runs: folder in which the folder of this run is made.
        resume: folder of an earlier run to go on with, with its settings.
        settings: what is changed of them: fields of the training (`model`, `vehicle`, `seed`, ...)
            or of its algorithm (`num_envs`, `learning_rate`, ...).

    Returns:
        The policy, which is also in the folder `policy` of the run; of several seeds the first.

    Raises:
        ConfigError: a setting is unknown or refused.
        MapError, TaskError: the maps, or the tasks on them, cannot be used.
        TrainingInterrupted: Ctrl-C stopped it, once all was saved.
    """
    chosen = load(Path(resume) / "config.yaml" if resume else configuration.find(config))
    configuration.expect_fields(settings, chosen, chosen.schedule)
    own = {field.name for field in fields(chosen)}
    changed = {name: settings[name] for name in settings if name in own}
    schedule = {name: settings[name] for name in settings if name not in own}
    if schedule:
        changed[chosen.name] = replace(chosen.schedule, **schedule)
    if isinstance(terrain, str | Path):
        changed["terrain"] = Path(terrain)
    changed |= {"runs": Path(runs), "resume": Path(resume) if resume else None}
    given = terrain if isinstance(terrain, TerrainMap) else None
    _, folder, _ = run(replace(chosen, **changed), given)
    return load_policy(folder)


def learned(config: TrainConfig, folder: Path) -> Rows:
    """The policies of a run, or of the folder of a policy, by their names in tables.

    They drive as `config` says: the same task or another one, planning or not. Raises as
    `load_policy`.
    """
    first = load_policy(folder)
    seeds, base = first.config.seeds, config.controller
    rows: Rows = {}
    for seed in range(seeds):
        trained = replace(load_policy(folder, seed) if seed else first, base=base)
        name = config.name if seeds == 1 else f"{config.name}, seed {seed}"
        rows[name] = trained.acting
        if config.planning:
            moves, weights = dynamics(config, config.planning.model)
            rows[f"{name} with planning"] = PolicyImprovement(
                env=NavigationEnv(moves, config.navigation),
                dynamics=weights,
                policy=trained.learned,
                value=trained.worth,
                base=base,
                interval=config.action_repeat,
                discount=config.schedule.discount,
                config=config.planning,
            )
    return rows
