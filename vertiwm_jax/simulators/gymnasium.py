"""The navigation task in a simulator outside jit, as a Gymnasium environment."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.env.gymnasium import NavigationGymEnv
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.suites import Tasks
from vertiwm_jax.env.task import NavigationConfig, TaskState
from vertiwm_jax.simulators import following
from vertiwm_jax.simulators.following import Followed
from vertiwm_jax.simulators.protocol import Observation, Simulator
from vertiwm_jax.terrain.map import TerrainMap


class SimulatorEnv(NavigationGymEnv):
    """One vehicle in a simulator; observation, reward and endings are those of `NavigationEnv`.

    simulator: such as `Chrono` or `BuiltIn`; every reset calls it with the world of its task.
    tasks: the pool that resets draw from; `ValueError` names the first that cannot be driven.
    config: `settle_steps` is not used, because simulators let the vehicle settle.
    """

    def __init__(
        self,
        simulator: Callable[[TerrainMap], Simulator],
        terrain: TerrainMap,
        tasks: Tasks,
        config: NavigationConfig = NavigationConfig(),
        render_mode: str | None = None,
    ) -> None:
        # Nothing settles in the pool, so that its starts are still where the tasks put them.
        env = NavigationEnv(Followed(), replace(config, settle_steps=0))
        super().__init__(env, env.make_params(jnp.zeros(12), terrain, tasks), render_mode)
        self._make = simulator

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """As `NavigationGymEnv.step`."""
        if self._state is not None:
            command = following.command(self._env, self._params, jnp.asarray(action))
            self._moved_to(self._simulator.step(command))
        return super().step(action)

    def _start(self) -> tuple[jax.Array, TaskState]:
        _, state = super()._start()
        self._simulator = self._make(self._params.terrain.select(state.world))
        x, y, _ = state.vehicle.position.tolist()
        self._moved_to(self._simulator.start(x, y, float(state.vehicle.rpy[2])))
        now = following.begin(self._env, self._params, state, self._params.dynamics)
        return now.observation, now.state

    def _moved_to(self, seen: Observation) -> None:
        """The vehicle is where the simulator has moved it."""
        self._params = replace(self._params, dynamics=jnp.asarray(seen.state))
