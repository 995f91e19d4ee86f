"""The navigation task of a vehicle that a simulator outside jit moves, and agents that drive it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.env.agent import Agent, Memory, Now
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import NavigationConfig, TaskParams, TaskState
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap


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


class AgentPilot:
    """An agent that commands a vehicle in a simulator outside jit, see `driving.drive`.

    state: of the task, as it goes on; path: position and roll, pitch, yaw `[6]` of all its states.
    """

    def __init__(
        self,
        env: NavigationEnv,
        task: TaskParams,
        agent: Agent,
        start: TaskState,
        key: jax.Array,
        next_goal: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> None:
        """`AgentPilot` of one episode, or of a drive from goal to goal.

        Args:
            env: the task, with the dynamics `Followed`.
            task: what it is run with.
            agent: what drives.
            start: a start of the pool, whose vehicle is replaced by the one that is seen.
            key: of all that is random.
            next_goal: draws the goal `[3]`, m, that follows one that is reached at `[2]` x, y, m.
                Without it the drive ends with the episode.
        """
        self.state, self.path = start, list[np.ndarray]()
        self._env, self._task, self._agent, self._key = env, task, agent, key
        self._next_goal = next_goal
        self._memory: Memory = None
        self._action: jax.Array | None = None

    def __call__(self, seen: np.ndarray) -> np.ndarray | None:
        """The command `[2]` at the state `[12]` that the vehicle is in; None once all is over."""
        env, vehicle = self._env, jnp.asarray(seen)
        task = replace(self._task, dynamics=vehicle)
        step = len(self.path)
        plan_key, act_key = jax.random.split(jax.random.fold_in(self._key, step))
        if self._action is None:
            now = begin(env, task, self.state, vehicle)
        else:
            now = _follow(env, task, self.state, self._action, act_key)
        if self._next_goal:
            now = self._from_goal_to_goal(now, self._next_goal)
        self.state = now.state
        self.path.append(np.concatenate([now.state.vehicle.position, now.state.vehicle.rpy]))
        if now.state.ending != TerminationReason.RUNNING:
            return None
        if self._action is None:
            self._memory = _init(self._agent, now)
        plans, keys = step % self._agent.interval == 0, (plan_key, act_key)
        action, self._memory = _decide(self._agent, now, self._memory, keys, plans)
        self._action = action
        return command(env, task, action)

    def _from_goal_to_goal(self, now: Now, draw: Callable[[np.ndarray], np.ndarray]) -> Now:
        """The same, as if the episode had begun here, with another goal where one is reached."""
        zero, config = jnp.int32(0), self._env.config
        state = replace(now.state, ending=zero, stalled=zero, time=zero)
        place = np.asarray(state.vehicle.position)
        if np.linalg.norm(state.goal - place) >= config.goal_radius:
            return replace(now, state=state)
        goal = jnp.asarray(draw(place[:2]), jnp.float32)
        terrain = now.task.terrain.select(state.world)
        routes = _route(config, terrain, now.task.vehicle, goal[:2])
        self._task = replace(self._task, routes=routes)
        state = replace(state, goal=goal, route=zero)
        return begin(self._env, replace(now.task, routes=routes), state, now.task.dynamics)


@partial(jax.jit, static_argnames="env")
def begin(env: NavigationEnv, task: TaskParams, state: TaskState, seen: jax.Array) -> Now:
    """An episode whose vehicle is in the state `[12]` that is seen, not in that of `state`."""
    vehicle, terrain = VehicleState.from_vector(seen), task.terrain.select(state.world)
    history = env.dynamics.init(task.dynamics, terrain, vehicle)
    state = replace(state, vehicle=vehicle, history=history)
    return Now(task, state, env.observe(None, state, None, task))


@partial(jax.jit, static_argnames="env")
def _follow(
    env: NavigationEnv, task: TaskParams, state: TaskState, action: jax.Array, key: jax.Array
) -> Now:
    """The task after the vehicle has moved."""
    observation, state, *_ = env.step_env(key, state, action, task)
    return Now(task, state, observation)


_route = jax.jit(NavigationConfig.route_to, static_argnums=0)


@jax.jit
def _init(agent: Agent, now: Now) -> Memory:
    return agent.init(now)


@partial(jax.jit, static_argnames="plans")
def _decide(
    agent: Agent, now: Now, memory: Memory, keys: tuple[jax.Array, jax.Array], plans: bool
) -> tuple[jax.Array, Memory]:
    """The action `[2]`, and the memory after it; plans: whether a plan is due before."""
    memory = agent.plan(now, memory, keys[0]) if plans else memory
    action, memory = agent.act(now, memory, keys[1])
    return jnp.clip(action, -1.0, 1.0), memory


def command(env: NavigationEnv, task: TaskParams, action: jax.Array) -> np.ndarray:
    return np.asarray(task.vehicle.command(action, env.config.speed_range).vector)
