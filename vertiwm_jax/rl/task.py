"""Off-road navigation as what is learned: the settings and environments of every algorithm."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import jax

from vertiwm_jax import machine
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.env import suites, tasks
from vertiwm_jax.env.chassis import Chassis
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.randomization import RandomizationConfig
from vertiwm_jax.env.suites import GroundConfig
from vertiwm_jax.env.task import NavigationConfig, TaskParams
from vertiwm_jax.env.tasks import Tasks
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import HMMWV, VehicleConfig
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model.choice import (
    Imagined,
    ModelName,
    Operands,
    choose,
    lean,
    rounded,
    sighted,
)


@dataclass(frozen=True)
class TaskConfig:
    """What is driven, where, and with what."""

    seed: int = 0
    """Decides everything that is random."""
    vehicle: str = HMMWV
    """What the built-in simulator drives: the name of a vehicle that comes along, or a YAML file of
    one; other models drive what they were fitted to."""
    worlds: Path | None = None
    """A Verti-Bench checkout or a folder of .npz maps; procedural worlds by default."""
    ground: GroundConfig = GroundConfig()
    """What worlds and tasks."""
    navigation: NavigationConfig = NavigationConfig()
    """What the task is; a vehicle other than the HMMWV brings a chassis of its own."""
    variation: RandomizationConfig = RandomizationConfig()
    """How episodes differ from what map and model say, while learning."""
    model: ModelName = "builtin"
    """What moves the vehicle while learning; tests after it are in the built-in simulator."""
    weights: Path | None = None
    """Folder of a fitted model, instead of the one that comes with the package."""
    operands: Operands | Literal["auto"] = "auto"
    """What learned models multiply; bfloat16 is faster on CPUs with AVX512_BF16, slower on others,
    and leaves errors of prediction what they are to 1 %. A training that begins with auto tries
    which it is, and keeps to it."""
    simulator: Simulator = Simulator()
    """The built-in simulator."""

    def __post_init__(self):
        vehicle.load(self.vehicle)  # That it cannot be read is to be said now.

    @property
    def multiplied(self) -> Operands:
        """`operands`, or which of them are faster here."""
        if self.operands == "auto":
            return "bfloat16" if machine.multiplies_bfloat16() else "float32"
        return self.operands

    @property
    def driven(self) -> VehicleConfig:
        """The vehicle; `ConfigError` if there is no such."""
        return vehicle.load(self.vehicle)

    @property
    def asked(self) -> NavigationConfig:
        """`navigation` for the vehicle."""
        if self.vehicle == HMMWV:
            return self.navigation
        return replace(self.navigation, chassis=Chassis.of(self.driven.vehicle))

    def key(self, purpose: Literal["worlds", "tasks", "training", "testing"]) -> jax.Array:
        """The random key of one purpose."""
        number = ("worlds", "tasks", "training", "testing").index(purpose)
        return jax.random.fold_in(jax.random.key(self.seed), number)


@dataclass(frozen=True)
class Task:
    """An environment and its parameters."""

    env: NavigationEnv
    params: TaskParams


def training_environment(config: TaskConfig) -> tuple[Task, TerrainMap]:
    """What to train in, and the worlds held out for `test_environment`.

    Raises like `training_ground`; weights that cannot be read raise `CheckpointError`.
    """
    terrain, pool, held_out = training_ground(config)
    return environment(config, config.model, terrain, pool, config.variation), held_out


def training_ground(config: TaskConfig) -> tuple[TerrainMap, Tasks, TerrainMap]:
    """The worlds to train on, tasks on them, and the worlds held out for `test_environment`.

    Maps that cannot be used, and tasks that cannot be driven on them, raise `ValueError`.
    """
    navigation, scale = config.asked, config.driven.scale
    terrain, held_out = suites.grounds(config.ground, config.worlds, config.key("worlds"), scale)
    # Now, and not when the training is over.
    tests = suites.test_tasks(config.ground, held_out)
    tasks.validate(tests, held_out, navigation.goal_radius, navigation.map_margin)
    pool = suites.training_tasks(config.ground, terrain, navigation.chassis, config.key("tasks"))
    return terrain, pool, held_out


def held_out(config: TaskConfig) -> TerrainMap:
    """The worlds that `training_environment` holds out."""
    key, scale = config.key("worlds"), config.driven.scale
    if config.worlds is None:
        return suites.suite_worlds(config.ground, key, scale)
    return suites.grounds(config.ground, config.worlds, key, scale)[1]


def test_environment(config: TaskConfig, terrain: TerrainMap, model: ModelName = "builtin") -> Task:
    """The test on these worlds, inside one of the models."""
    return environment(config, model, terrain, suites.test_tasks(config.ground, terrain))


def environment(
    config: TaskConfig,
    model: ModelName,
    terrain: TerrainMap,
    pool: Tasks,
    variation: RandomizationConfig = RandomizationConfig(),
) -> Task:
    """Tasks inside one of the models."""
    moves, params = dynamics(config, model)
    env = NavigationEnv(moves, config.asked, variation)
    return Task(env, env.make_params(params, terrain, pool))


def dynamics(config: TaskConfig, model: Imagined) -> tuple[Dynamics, Params]:
    """One of the models, and its parameters."""
    if model == "builtin":
        moves, params = config.simulator, chrono_like(config.driven.vehicle)
    else:
        moves, params = choose(model, config.weights, vehicle=config.driven.vehicle)
        params = rounded(params, config.multiplied)
    if config.navigation.embeddings:
        return sighted(model, moves, params, config.weights)
    return lean(moves), params


def outcomes(info: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """What is reported of an episode's last step."""
    ending = info["ending"]
    return {
        "success": ending == TerminationReason.GOAL,
        "timed_out": ending == TerminationReason.TIMED_OUT,
        "final_distance": info["distance"],
    }
