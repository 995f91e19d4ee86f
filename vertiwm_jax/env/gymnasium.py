"""The navigation task as Gymnasium environments: one vehicle, or many at once."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from vertiwm_jax import machine
from vertiwm_jax.env._gymnax import gymnax_space_to_gym_space
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
_keys = jax.jit(jax.vmap(jax.random.key))
_Seen = tuple[jax.Array, TaskState]


@partial(jax.jit, static_argnums=0)
def _reset_some(
    env: NavigationEnv, keys: jax.Array, mask: jax.Array, seen: _Seen | None, params: TaskParams
) -> tuple[jax.Array, _Seen]:
    """Next keys `[N]`, and observations `[N, O]` and states, new ones where the mask `[N]` is."""
    keys, now = jnp.unstack(jax.vmap(jax.random.split)(keys), axis=1)
    begun = jax.vmap(env.reset_env, (0, None))(now, params)
    if seen is None:
        return keys, begun
    return keys, jax.tree.map(lambda new, old: jax.vmap(jnp.where)(mask, new, old), begun, seen)


@partial(jax.jit, static_argnums=0)
def _step_all(
    env: NavigationEnv, keys: jax.Array, state: TaskState, actions: jax.Array, params: TaskParams
) -> tuple[jax.Array, Any]:
    """Next keys `[N]`, and what `step_env` gives for each vehicle."""
    keys, now = jnp.unstack(jax.vmap(jax.random.split)(keys), axis=1)
    return keys, jax.vmap(env.step_env, (0, 0, 0, None))(now, state, actions, params)


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
        """Draws a start from the pool.

        Raises:
            ValueError: an option is given, and there is none.
            UserError: this process was forked after JAX had started.
        """
        machine.refuse_forked()
        _refuse(options)
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
    """N vehicles in one compiled step.

    num_envs: N.
    autoreset_mode: when a vehicle whose episode is over begins anew. In the same step by default:
        `info["final_obs"]` and `info["final_info"]` then hold what its episode ended with. Or in
        the next step, whose action it ignores. Or when `reset(options={"reset_mask": mask})` says.
    """

    def __init__(
        self,
        env: NavigationEnv,
        params: TaskParams,
        num_envs: int,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    ) -> None:
        self.num_envs, self._mode = num_envs, AutoresetMode(autoreset_mode)
        self.metadata = {"autoreset_mode": self._mode}
        self.single_observation_space = gymnax_space_to_gym_space(env.observation_space())
        self.single_action_space = gymnax_space_to_gym_space(env.action_space())
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._env, self._params = env, params
        self._seen: _Seen | None = None
        self._over = np.zeros(num_envs, bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Draws new starts from the pool.

        Args:
            seed: of the first vehicle, the others have the numbers that follow; or one for each.
                None draws on.
            options: "reset_mask" `[N]` bool: the vehicles that begin anew; all by default.

        Raises:
            ValueError: an option is unknown, or the seeds or the mask are not N.
        """
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, bool)))
        _refuse(options)
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise ValueError(
                f"reset_mask: expected [{self.num_envs}] bool, at least one of them true, found "
                f"{mask.tolist()}"
            )
        if self._seen is None and not mask.all():
            raise gymnasium.error.ResetNeeded("reset_mask: reset all vehicles first")
        if isinstance(seed, int | np.integer):
            seed = range(int(seed), int(seed) + self.num_envs)
        seeds = [None] * self.num_envs if seed is None else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: expected {self.num_envs} of them, found {len(seeds)}")
        # Without a seed, a sequence begins anywhere.
        drawn = [np.random.SeedSequence(seed).generate_state(1)[0] for seed in seeds]
        keys = _keys(np.array(drawn))
        if self._seen is not None:
            given = [seed is not None for seed in seeds]
            keys = jnp.where(mask & given, keys, self._key)
        self._key = keys
        return self._begin(mask), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of 0.1 s."""
        if self._seen is None:
            raise gymnasium.error.ResetNeeded("step: call reset() first")
        mode, waiting = self._mode, self._over
        if mode is AutoresetMode.DISABLED and waiting.any():
            ended = np.flatnonzero(waiting).tolist()
            raise gymnasium.error.ResetNeeded(f"step: reset vehicles {ended} first, by reset_mask")
        self._key, (observation, state, *outcome) = _step_all(
            self._env, self._key, self._seen[1], actions, self._params
        )
        self._seen = observation, state
        # Copies, since arrays of JAX are read-only.
        reward, terminated, info = jax.tree.map(np.array, outcome)
        info = _named(info)
        truncated = info["ending"] == "timed_out"
        # Episodes that are over stay as they are, so that those that wait have ended again.
        terminated, truncated = terminated & ~waiting, truncated & ~waiting
        over = terminated | truncated
        begin = over if mode is AutoresetMode.SAME_STEP else waiting
        infos = _with_masks(info, ~begin)
        if mode is AutoresetMode.SAME_STEP and over.any():
            final = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(over):
                final[i] = np.array(observation[i])
            infos |= _with_masks({"final_obs": final, "final_info": _with_masks(info, over)}, over)
        self._over = over
        seen = self._begin(begin) if begin.any() else np.array(observation)
        return seen, reward, terminated, truncated, infos

    def _begin(self, mask: np.ndarray) -> np.ndarray:
        """All observations, after those of the mask have begun anew."""
        self._key, seen = _reset_some(self._env, self._key, mask, self._seen, self._params)
        self._seen, self._over = seen, self._over & ~mask
        return np.array(seen[0])


def _refuse(options: dict[str, Any] | None) -> None:
    if options:
        raise ValueError(f"options: expected none of these, found {', '.join(options)}")


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
