"""The navigation task as Gymnasium environments: one vehicle, or many at once."""

from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from gymnax.environments.spaces import gymnax_space_to_gym_space

from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import TaskParams, TaskState
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain import picture as pictures

_VEHICLE, _GOAL = (0.80, 0.05, 0.05), (0.00, 0.25, 0.75)  # red, blue
_ENDINGS = np.array([reason.name.lower() for reason in TerminationReason])

# Equal environments share what these compile.
_reset = jax.jit(NavigationEnv.reset_env, static_argnums=0)
_step = jax.jit(NavigationEnv.step_env, static_argnums=0)
_reset_all = jax.jit(jax.vmap(NavigationEnv.reset, (None, 0, None)), static_argnums=0)
_step_all = jax.jit(jax.vmap(NavigationEnv.step, (None, 0, 0, 0, None)), static_argnums=0)


class NavigationGymEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One vehicle; passes `gymnasium.utils.env_checker.check_env`.

    render_mode: None or "rgb_array", a picture of the world from above.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / STEP_SECONDS)}  # noqa: RUF012

    def __init__(
        self, env: NavigationEnv, params: TaskParams, render_mode: str | None = None
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f'render_mode: expected None or "rgb_array", found {render_mode!r}')
        self.observation_space = gymnax_space_to_gym_space(env.observation_space())
        self.action_space = gymnax_space_to_gym_space(env.action_space())
        self.render_mode = render_mode
        self._env, self._params = env, params
        self._state: TaskState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Draws a start from the pool. `options` is not used."""
        super().reset(seed=seed)
        self._key = jax.random.key(self.np_random.integers(2**31))
        observation, self._state = self._start()
        return np.asarray(observation), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One step of 0.1 s, without reset at the end."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step: call reset() first")
        observation, self._state, reward, terminated, info = _step(
            self._env, self._key, self._state, action, self._params
        )
        info = {name: value.item() for name, value in _named(info).items()}
        truncated = info["ending"] == "timed_out"
        return np.asarray(observation), reward.item(), bool(terminated), truncated, info

    def render(self) -> np.ndarray | None:
        """`[H, W, 3]` uint8, north up, or None without a render mode."""
        if self.render_mode is None or self._state is None:
            return None
        return _from_above(self._env.config.goal_radius, self._params, self._state)

    def _start(self) -> tuple[jax.Array, TaskState]:
        return _reset(self._env, self._key, self._params)


class NavigationVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many vehicles in one compiled step, each reset in the step that ends its episode.

    Where an episode ended, `info["final_obs"]` and `info["final_info"]` hold what it ended with.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, env: NavigationEnv, params: TaskParams, num_envs: int) -> None:
        self.num_envs = num_envs
        self.single_observation_space = gymnax_space_to_gym_space(env.observation_space())
        self.single_action_space = gymnax_space_to_gym_space(env.action_space())
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._env, self._params = env, params
        self._state: TaskState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Draws new starts for all vehicles from the pool. `options` is not used."""
        super().reset(seed=seed)
        self._key = jax.random.key(self.np_random.integers(2**31))
        observation, self._state = _reset_all(self._env, self._next_keys(), self._params)
        return np.array(observation), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of 0.1 s; ended vehicles return the first observation of their next episode."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step: call reset() first")
        observation, self._state, *outcome = _step_all(
            self._env, self._next_keys(), self._state, actions, self._params
        )
        # Copies, since arrays of JAX are read-only.
        reward, terminated, truncated, info = jax.tree.map(np.array, outcome)
        info = _named(info)
        final_observation = info.pop("final_observation")
        del info["terminated"], info["truncated"]
        over = terminated | truncated
        infos = _with_masks(info, ~over)
        if over.any():
            final = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(over):
                final[i] = final_observation[i]
            infos |= _with_masks({"final_obs": final, "final_info": _with_masks(info, over)}, over)
        return np.array(observation), reward, terminated, truncated, infos

    def _next_keys(self) -> jax.Array:
        keys = jax.random.split(self._key, self.num_envs + 1)
        self._key = keys[0]
        return keys[1:]


def _named(info: dict[str, Any]) -> dict[str, Any]:
    """The same with the reason of termination by name, like "goal"."""
    return info | {"ending": _ENDINGS[np.asarray(info["ending"])]}


def _with_masks(info: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Adds Gymnasium's masks: for which environments each entry holds."""
    return info | {f"_{name}": mask.copy() for name in info}


def _from_above(goal_radius: float, params: TaskParams, state: TaskState) -> np.ndarray:
    """`[H, W, 3]` uint8, north up: the vehicle as a red box with a white nose, the goal a ring."""
    terrain, vehicle = params.terrain, params.vehicle
    picture = pictures.shaded(terrain, int(state.world))
    west, east, south, north = pictures.extent(terrain)
    (east_of, north_of, _), yaw = np.asarray(state.vehicle.position), float(state.vehicle.rpy[2])
    goal = np.asarray(state.goal)
    height, width, _ = picture.shape
    x = west + (np.arange(width) + 0.5) * (east - west) / width
    y = (north - (np.arange(height) + 0.5) * (north - south) / height)[:, None]
    pixel = (east - west) / width
    ring = np.abs(np.hypot(x - goal[0], y - goal[1]) - goal_radius) < 1.5 * pixel
    picture[ring] = _GOAL
    ahead = np.cos(yaw) * (x - east_of) + np.sin(yaw) * (y - north_of)
    left = np.cos(yaw) * (y - north_of) - np.sin(yaw) * (x - east_of)
    body = (np.abs(ahead) <= vehicle.length / 2) & (np.abs(left) <= vehicle.width / 2)
    picture[body] = _VEHICLE
    picture[body & (ahead > vehicle.length / 4)] = 1.0
    return (255 * picture).round().astype(np.uint8)
