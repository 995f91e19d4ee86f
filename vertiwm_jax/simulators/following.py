"""The navigation task of a vehicle that a simulator outside jit moves."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import TaskParams, TaskState
from vertiwm_jax.simulators.protocol import Simulator
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model.perception import Sighted, SightedParams


@dataclass(frozen=True)
class Followed:
    """The dynamics of a vehicle that something else moves; parameters: `[12]` its next state."""

    def init(self, params: jax.Array, terrain: TerrainMap, state: VehicleState) -> tuple[()]:
        return ()

    def step(
        self,
        params: jax.Array,
        terrain: TerrainMap,
        history: tuple[()],
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, tuple[()]]:
        return VehicleState.from_vector(params), ()


def followed(env: NavigationEnv) -> NavigationEnv:
    """The same task, with the vehicle moved from outside; it sees by the same encoders."""
    dynamics = env.dynamics
    if isinstance(dynamics, Sighted):
        return replace(env, dynamics=replace(dynamics, dynamics=Followed()))
    return replace(env, dynamics=Followed())


def start(
    simulator: Simulator,
    env: NavigationEnv,
    params: TaskParams,
    state: TaskState,
    pose: Sequence[float],
) -> tuple[jax.Array, TaskState]:
    """Observation and state of an episode whose vehicle stands in `simulator`.

    state: a start of the pool, whose vehicle is replaced; pose: `[3]` x, y, m, and yaw, rad.
    """
    seen = jnp.asarray(simulator.start(*pose).state)
    return _begin(env, _moved(params, seen), state, seen)


def move(
    simulator: Simulator, env: NavigationEnv, params: TaskParams, action: jax.Array
) -> TaskParams:
    """Does the action `[2]` in `simulator`; `Followed` does the same with these parameters."""
    seen = simulator.step(np.asarray(params.vehicle.command(action, env.config.speed_range).vector))
    return _moved(params, jnp.asarray(seen.state))


def _moved(params: TaskParams, state: jax.Array) -> TaskParams:
    dynamics = params.dynamics
    if isinstance(dynamics, SightedParams):
        return replace(params, dynamics=replace(dynamics, dynamics=state))
    return replace(params, dynamics=state)


@partial(jax.jit, static_argnames="env")
def _begin(
    env: NavigationEnv, params: TaskParams, state: TaskState, seen: jax.Array
) -> tuple[jax.Array, TaskState]:
    vehicle, terrain = VehicleState.from_vector(seen), params.terrain.select(state.world)
    history = env.dynamics.init(params.dynamics, terrain, vehicle)
    state = replace(state, vehicle=vehicle, history=history)
    return env.observe(None, state, None, params), state
