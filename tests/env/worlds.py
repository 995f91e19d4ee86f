"""Small grounds and vehicles that the tests of environments and evaluation share."""

from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.env.agent import Now
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.suites import Tasks
from vertiwm_jax.env.task import NavigationConfig, TaskParams
from vertiwm_jax.mechanics.kinematic import BicycleParams, KinematicBicycle
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap

BICYCLE = BicycleParams(
    wheelbase=jnp.float32(3.378),
    track=jnp.float32(1.82),
    ride_height=jnp.float32(0.47),
    speed_lag=jnp.float32(0.3),
)
GRASS, SNOW = 3, 9


def hills(size: int = 129, height: float = 1.0, wavelength: float = 40.0) -> np.ndarray:
    """`[size, size]` m of smooth waves, not below 0; amplitude `height` each way."""
    x = np.arange(size)
    wave = np.sin(2 * np.pi * x / wavelength)
    return (height * (2 + wave[None, :] + np.cos(2 * np.pi * x / wavelength)[:, None])).astype(
        np.float32
    )


def ground(elevation: np.ndarray | None = None, obstacles: Any = None) -> TerrainMap:
    """Grass, 128 m x 128 m about (0, 0); flat unless `elevation` is given."""
    if elevation is None:
        elevation = np.zeros((129, 129))
    return TerrainMap.from_array(elevation, np.full((16, 16), GRASS), obstacles=obstacles)


def task(start: Any, goal: Any, yaw: float = 0.0) -> Tasks:
    """One task on world 0."""
    return Tasks(
        world=jnp.zeros(1, jnp.int32),
        start=jnp.asarray([start], jnp.float32),
        yaw=jnp.asarray([yaw], jnp.float32),
        goal=jnp.asarray([goal], jnp.float32),
    )


def bicycle_env(
    terrain: TerrainMap, tasks: Tasks, config: NavigationConfig | None = None
) -> tuple[NavigationEnv, TaskParams]:
    """A kinematic bicycle over `terrain`."""
    env = NavigationEnv(KinematicBicycle(), config or NavigationConfig())
    return env, env.make_params(BICYCLE, terrain, tasks)


def begin(env: NavigationEnv, task: TaskParams, index: int = 0) -> Now:
    """A start of the pool."""
    observation, state = env.start(task, jnp.int32(index))
    return Now(task, state, observation)


def blocked(config: NavigationConfig) -> tuple[NavigationEnv, TaskParams]:
    """A goal straight ahead, behind a wall 3 m wide; and the same the other way."""
    terrain = ground(obstacles=[[0.0, 0.0, 2.0, 3.0, 2.0]])
    there, back = task((-20.0, 0.0), (20.0, 0.0)), task((20.0, 0.0), (-20.0, 0.0), jnp.pi)
    return bicycle_env(terrain, jax.tree.map(lambda *x: jnp.concatenate(x), there, back), config)


@dataclass(frozen=True)
class Scripted:
    """Stands still while starts settle, then goes through states given as parameters.

    Parameters are states with leaves `[T, 3]`; history counts the steps that moved.
    """

    settle_steps: int

    def init(self, params: VehicleState, terrain: TerrainMap, state: VehicleState) -> jax.Array:
        return jnp.int32(-self.settle_steps)

    def step(
        self,
        params: VehicleState,
        terrain: TerrainMap,
        history: jax.Array,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, jax.Array]:
        there = jax.tree.map(lambda x: x[jnp.maximum(history, 0)], params)
        moved = jax.tree.map(lambda a, b: jnp.where(history < 0, a, b), state, there)
        return moved, history + 1


def step_of_many(env: NavigationEnv, action: jax.Array):
    """Steps `(key, states, params)` of all with one action, compiled once and no second time."""
    chex.clear_trace_counter()

    @jax.jit
    @chex.assert_max_traces(n=1)
    def step(key, states, params):
        number = len(states.time)
        keys, actions = jax.random.split(key, number), jnp.broadcast_to(action, (number, 2))
        return jax.vmap(env.step, (0, 0, 0, None))(keys, states, actions, params)

    return step
