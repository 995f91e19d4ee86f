"""The navigation task of a vehicle that a simulator outside jit moves, and agents that drive it."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
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


@dataclass
class AgentPilot:
    """An agent that commands a vehicle in a simulator outside jit, see `protocol.drive`.

    env: the task, with the dynamics `Followed`; task: what it is run with.
    agent: what drives.
    state: of the task, as it goes on. At first a start of the pool, whose vehicle is replaced by
        the one that is seen.
    key: of all that is random.
    next_goal: draws the goal `[3]`, m, that follows one that is reached at `[2]` x, y, m. Without
        it the drive ends with the episode.
    path: position and roll, pitch, yaw `[6]` of all its states.
    memory, action: the last ones; None before the first.
    """

    env: NavigationEnv
    task: TaskParams
    agent: Agent
    state: TaskState
    key: jax.Array
    next_goal: Callable[[np.ndarray], np.ndarray] | None = None
    path: list[np.ndarray] = field(default_factory=list)
    memory: Memory = None
    action: jax.Array | None = None

    def __call__(self, seen: np.ndarray) -> np.ndarray | None:
        """The command `[2]` at the state `[12]` that the vehicle is in; None once all is over."""
        env, vehicle = self.env, jnp.asarray(seen)
        task = replace(self.task, dynamics=vehicle)
        step = len(self.path)
        plan_key, act_key = jax.random.split(jax.random.fold_in(self.key, step))
        if self.action is None:
            now = begin(env, task, self.state, vehicle)
        else:
            observation, state, *_ = _step(env, act_key, self.state, self.action, task)
            now = Now(task, state, observation)
        if self.next_goal:
            now = self._from_goal_to_goal(now, self.next_goal)
        self.state = now.state
        self.path.append(np.concatenate([now.state.vehicle.position, now.state.vehicle.rpy]))
        if now.state.ending != TerminationReason.RUNNING:
            return None
        if self.action is None:
            self.memory = _init(self.agent, now)
        plans, keys = step % self.agent.interval == 0, (plan_key, act_key)
        action, self.memory = _decide(self.agent, now, self.memory, keys, plans)
        self.action = action
        return command(env, task, action)

    def _from_goal_to_goal(self, now: Now, draw: Callable[[np.ndarray], np.ndarray]) -> Now:
        """The same, as if the episode had begun here, with another goal where one is reached."""
        zero, config = jnp.int32(0), self.env.config
        state = replace(now.state, ending=zero, stalled=zero, backing=zero, time=zero)
        place = np.asarray(state.vehicle.position)
        if np.linalg.norm(state.goal - place) >= config.goal_radius:
            return replace(now, state=state)
        goal = jnp.asarray(draw(place[:2]), jnp.float32)
        terrain = now.task.terrain.select(state.world)
        routes = _route(config, terrain, now.task.vehicle, goal[:2])
        self.task = replace(self.task, routes=routes)
        state = replace(state, goal=goal, route=zero)
        return begin(self.env, replace(now.task, routes=routes), state, now.task.dynamics)


@partial(jax.jit, static_argnames="env")
def begin(env: NavigationEnv, task: TaskParams, state: TaskState, seen: jax.Array) -> Now:
    """An episode whose vehicle is in the state `[12]` that is seen, not in that of `state`."""
    vehicle, terrain = VehicleState.from_vector(seen), task.terrain.select(state.world)
    history = env.dynamics.init(task.dynamics, terrain, vehicle)
    state = replace(state, vehicle=vehicle, history=history)
    return Now(task, state, env.observe(None, state, None, task))


_step = jax.jit(NavigationEnv.step_env, static_argnums=0)
_route = jax.jit(NavigationConfig.route_to, static_argnums=0)
_init = jax.jit(lambda agent, now: agent.init(now))


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
