"""The task by its name: importing this module registers it with Gymnasium and with gymnax.

import gymnasium, gymnax, vertiwm_jax.gym

env = gymnasium.make("vertiwm_jax/OffRoadNavigation-v0", terrain="MAPS", model="builtin")
envs = gymnasium.make_vec("vertiwm_jax/OffRoadNavigation-v0", num_envs=64)
env, env_params = gymnax.make("OffRoadNavigation-v0", model="nesam")
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import gymnasium
import gymnax
import jax

from vertiwm_jax.env.gymnasium import NavigationGymEnv, NavigationVectorEnv
from vertiwm_jax.env.navigation import NavigationEnv, make_env
from vertiwm_jax.env.task import NavigationConfig, TaskParams
from vertiwm_jax.env.tasks import random_tasks
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.models.registry import ModelName, load_encoders, load_model
from vertiwm_jax.terrain import worlds
from vertiwm_jax.terrain.files import load_map
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.worlds import WorldConfig

GYMNAX_NAME = "OffRoadNavigation-v0"
NAME = f"vertiwm_jax/{GYMNAX_NAME}"


def make(
    terrain: TerrainMap | str | Path | None = None,
    model: str = "builtin",
    render_mode: str | None = None,
    **settings: Any,
) -> NavigationGymEnv:
    """One vehicle; what `gymnasium.make` calls.

    Args:
        terrain: worlds, or a map file, or a folder of maps; procedural worlds by default.
        model: what moves the vehicle.
        render_mode: None or "rgb_array".
        settings: others of `make_env`.
    """
    return NavigationGymEnv(*_task(terrain, model, settings), render_mode)


def make_vec(
    num_envs: int = 1,
    terrain: TerrainMap | str | Path | None = None,
    model: str = "builtin",
    **settings: Any,
) -> NavigationVectorEnv:
    """Many vehicles in one compiled step; what `gymnasium.make_vec` calls."""
    return NavigationVectorEnv(*_task(terrain, model, settings), num_envs)


def _task(
    terrain: TerrainMap | str | Path | None, model: Any, settings: dict[str, Any]
) -> tuple[NavigationEnv, TaskParams]:
    if isinstance(terrain, str | Path):
        terrain = load_map(terrain)
    return make_env(terrain, model, **settings)


@dataclass(frozen=True)
class ProceduralNavigation(NavigationEnv):
    """Goal navigation on procedural worlds, which are its default parameters; for `gymnax.make`.

    To choose maps, tasks or weights yourself, use `make_env`.

    relief: what the worlds are like. number: of worlds; starts: of random tasks on all of them.
    model: what moves the vehicle, of which `dynamics` is the object. seed: draws worlds and tasks.
    """

    model: ModelName = "builtin"
    relief: WorldConfig = WorldConfig()
    number: int = 8
    starts: int = 256
    seed: int = 0

    @classmethod
    def of(
        cls,
        model: ModelName = "builtin",
        config: NavigationConfig = NavigationConfig(),
        **settings,
    ) -> Self:
        """The environment in a model of `load_model`, with any of the other settings."""
        dynamics, _ = load_model(model, embeddings=config.embeddings)
        return cls(dynamics, config, model=model, **settings)

    @property
    def default_params(self) -> TaskParams:
        """Drawn and settled anew whenever asked for, in seconds: keep them, and pass them on."""
        world_key, task_key = jax.random.split(jax.random.key(self.seed))
        terrain = worlds.generate(jax.random.split(world_key, self.number), self.relief)
        tasks = random_tasks(task_key, terrain, self.starts, load_vehicle())
        encoders = load_encoders() if self.config.embeddings else None
        return self.make_params(load_model(self.model)[1], terrain, tasks, encoders=encoders)


gymnasium.register(NAME, make, vector_entry_point=make_vec)
gymnax.register(GYMNAX_NAME, ProceduralNavigation.of)
