"""Off-road navigation as what is learned: the settings and environments of every algorithm."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax

from vertiwm_jax.env.navigation import NavigationConfig, NavigationEnv, NavigationParams
from vertiwm_jax.env.termination import Ending
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import hmmwv
from vertiwm_jax.rl import ground
from vertiwm_jax.rl.ground import GroundConfig
from vertiwm_jax.terrain.map import TerrainMap


@dataclass(frozen=True)
class TaskConfig:
    """What is driven, where, and with what."""

    seed: int = 0
    """Decides everything that is random."""
    worlds: Path | None = None
    """A Verti-Bench checkout or a folder of .npz maps; procedural worlds by default."""
    ground: GroundConfig = GroundConfig()
    """What worlds and tasks."""
    navigation: NavigationConfig = NavigationConfig()
    """What the task is."""
    simulator: Simulator = Simulator()
    """What moves the vehicle."""

    def key(self, purpose: Literal["worlds", "tasks", "training", "testing"]) -> jax.Array:
        """The random key of one purpose."""
        number = ("worlds", "tasks", "training", "testing").index(purpose)
        return jax.random.fold_in(jax.random.key(self.seed), number)


def environments(config: TaskConfig) -> tuple[NavigationEnv, NavigationParams, NavigationParams]:
    """The environment, its parameters to train with, and those to test with.

    Maps that cannot be used, and tasks that cannot be driven on them, raise `ValueError`.
    """
    terrain, held_out = ground.grounds(config.ground, config.worlds, config.key("worlds"))
    chassis = config.navigation.chassis
    tasks = ground.training_tasks(config.ground, terrain, chassis, config.key("tasks"))
    env, test = test_environment(config, held_out)
    return env, env.make_params(chrono_like(hmmwv()), terrain, tasks), test


def held_out(config: TaskConfig) -> TerrainMap:
    """The worlds that `environments` tests on."""
    return ground.grounds(config.ground, config.worlds, config.key("worlds"))[1]


def test_environment(
    config: TaskConfig, terrain: TerrainMap
) -> tuple[NavigationEnv, NavigationParams]:
    """The environment, and its parameters to test with on these worlds."""
    env = NavigationEnv(config.simulator, config.navigation)
    tasks = ground.test_tasks(config.ground, terrain)
    return env, env.make_params(chrono_like(hmmwv()), terrain, tasks)


def outcomes(info: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """What is reported of an episode's last step."""
    ending = info["ending"]
    return {
        "success": ending == Ending.GOAL,
        "timed_out": ending == Ending.TIMED_OUT,
        "final_distance": info["distance"],
    }
