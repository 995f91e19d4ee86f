"""The task by its name: importing this module registers it with Gymnasium and with gymnax.

import gymnasium, vertiwm_jax.gym

env = gymnasium.make("vertiwm_jax/OffRoadNavigation-v0", terrain="MAPS", model="builtin")
envs = gymnasium.make_vec("vertiwm_jax/OffRoadNavigation-v0", num_envs=64)
"""

from pathlib import Path
from typing import Any

import gymnasium

from vertiwm_jax.env.gymnasium import NavigationGymEnv, NavigationVectorEnv
from vertiwm_jax.env.gymnax import NAME as _GYMNAX_NAME
from vertiwm_jax.env.navigation import NavigationEnv, make_env
from vertiwm_jax.env.task import TaskParams
from vertiwm_jax.terrain.files import load_map
from vertiwm_jax.terrain.map import TerrainMap

NAME = f"vertiwm_jax/{_GYMNAX_NAME}"


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


gymnasium.register(NAME, make, vector_entry_point=make_vec)
