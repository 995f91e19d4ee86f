"""The task by its name: importing this module registers it with Gymnasium and with gymnax.

import gymnasium, gymnax, vertiwm_jax.gym

env = gymnasium.make("vertiwm_jax/OffRoadNavigation-v0", terrain="MAPS", model="builtin")
envs = gymnasium.make_vec("vertiwm_jax/OffRoadNavigation-v0", num_envs=64)
env, env_params = gymnax.make("OffRoadNavigation-v0", model="nesam")
"""

from dataclasses import dataclass, field
from typing import Any

import gymnasium
import gymnax
from gymnasium.vector import AutoresetMode

from vertiwm_jax.env.gymnasium import NavigationGymEnv, NavigationVectorEnv
from vertiwm_jax.env.navigation import NavigationEnv, make_env
from vertiwm_jax.env.task import TaskParams

GYMNAX_NAME = "OffRoadNavigation-v0"
NAME = f"vertiwm_jax/{GYMNAX_NAME}"


def make(render_mode: str | None = None, **settings: Any) -> NavigationGymEnv:
    """One vehicle; what `gymnasium.make` calls.

    render_mode: None or "rgb_array"; settings: arguments of `make_env`.
    """
    return NavigationGymEnv(*make_env(**settings), render_mode)


def make_vec(
    num_envs: int = 1,
    autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    **settings: Any,
) -> NavigationVectorEnv:
    """Many vehicles in one compiled step; what `gymnasium.make_vec` calls.

    autoreset_mode: see `NavigationVectorEnv`; settings: arguments of `make_env`.
    """
    return NavigationVectorEnv(*make_env(**settings), num_envs, autoreset_mode)


def make_gymnax(**settings: Any) -> "GymnaxNavigation":
    """The task with its parameters as default ones; what `gymnax.make` calls."""
    env, params = make_env(**settings)
    return GymnaxNavigation(env.dynamics, env.config, default_params=params)


@dataclass(frozen=True)
class GymnaxNavigation(NavigationEnv):
    """`NavigationEnv` that has default parameters, as `gymnax.make` asks for them."""

    default_params: TaskParams | None = field(default=None, compare=False)  # pyright: ignore


gymnasium.register(NAME, make, vector_entry_point=make_vec)
gymnax.register(GYMNAX_NAME, make_gymnax)
