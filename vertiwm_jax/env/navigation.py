"""Goal navigation over any vehicle model, as a gymnax environment."""

import dataclasses
import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnax.environments import environment, spaces

from vertiwm_jax import devices
from vertiwm_jax.dynamics import (
    EMBEDDING_SHAPE,
    Dynamics,
    History,
    Params,
    disagreement,
    embedding,
    spread,
)
from vertiwm_jax.env import observation, route, tasks
from vertiwm_jax.env.chassis import Chassis
from vertiwm_jax.env.reward import RewardConfig, reward
from vertiwm_jax.env.route import RouteConfig, Routes
from vertiwm_jax.env.tasks import Tasks
from vertiwm_jax.env.termination import Ending, edge_distance, first_ending, is_terminal
from vertiwm_jax.env.variation import Variation, VariationConfig
from vertiwm_jax.networks.policy import Senses
from vertiwm_jax.state import STEP_SECONDS, Command, VehicleState
from vertiwm_jax.terrain import crop, obstacles, query, reveal
from vertiwm_jax.terrain.belief import MapBelief
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.reveal import RevealConfig

_SETTLED_TOGETHER = 64  # vehicles on a device, of which each has patches in every step


@dataclasses.dataclass(frozen=True)
class NavigationConfig:
    """What the task asks, static.

    goal_radius: m from the goal, in three dimensions, at which it is reached.
    horizon_seconds: time limit.
    speed_range: commanded speed in m/s at actions -1 and 1; negative drives backwards.
    map_margin: m from the edge of the map at which a vehicle is off it.
    rollover_angle: rad of roll or of pitch.
    stalled_speed, stuck_seconds: slower than this is stalled, for this long without a break stuck.
    plausible_speed, plausible_height: m/s, and m from the ground, beyond which a model diverged.
    plausible_disagreement: m by which its parts may disagree in a step before it has diverged.
    settle_steps: steps of standing still before a start is handed out.
    embeddings: whether an observation ends with the ground as the model's encoders see it.
    route: how the way to the goal is found; it is straight where the map is not all known.
    reveal: what sensors reveal of a map that is not known; by default all of it is.
    """

    goal_radius: float = 8.0
    horizon_seconds: float = 60.0
    speed_range: tuple[float, float] = (0.0, 6.0)
    map_margin: float = 1.0
    rollover_angle: float = np.pi / 3
    stalled_speed: float = 0.3
    stuck_seconds: float = 5.0
    plausible_speed: float = 30.0
    plausible_height: float = 4.0
    plausible_disagreement: float = np.inf
    settle_steps: int = 15
    embeddings: bool = False
    chassis: Chassis = dataclasses.field(default_factory=Chassis)
    reward: RewardConfig = dataclasses.field(default_factory=RewardConfig)
    route: RouteConfig = RouteConfig()
    reveal: RevealConfig = RevealConfig()

    def __post_init__(self) -> None:
        if self.reveal.partial and self.embeddings:
            raise ValueError(
                "reveal.range: expected inf with embeddings, which show all of the map, "
                f"found {self.reveal.range:g}"
            )

    def route_to(self, terrain: TerrainMap, goal: jax.Array) -> Routes:
        """The route to the goal `[2]`, m, in the selected world; can be compiled."""
        if self.reveal.partial:
            return route.straight(self.route, terrain, goal[None])
        return route.plan_one(self.route, terrain, self.chassis, goal)

    def command(self, action: jax.Array) -> Command:
        """`[..., 2]` action, clipped to [-1, 1], to the command it stands for."""
        action = jnp.clip(action, -1.0, 1.0)
        low, high = self.speed_range
        speed = low + (action[..., 0] + 1) / 2 * (high - low)
        return Command(speed, action[..., 1] * self.chassis.steering_limit)

    def action(self, command: Command) -> jax.Array:
        """The `[..., 2]` action of a command, clipped to [-1, 1]; the inverse of `command`."""
        low, high = self.speed_range
        speed = (command.speed - low) / (high - low) * 2 - 1
        steering = command.steering / self.chassis.steering_limit
        return jnp.clip(jnp.stack([speed, steering], -1), -1.0, 1.0)


@struct.dataclass(kw_only=True)
class NavigationState(environment.EnvState):
    """One episode under way.

    vehicle, history: the model's.
    world: `[]` int32; goal: `[3]` m; route: `[]` int32, which of all routes leads there.
    action: `[2]` the last one, in [-1, 1].
    time: `[]` int32 steps done; stalled: `[]` int32 steps stalled without a break.
    ending: `[]` int32 `Ending` code.
    variation: how this episode differs from what the map says.
    belief: what the vehicle has seen of its world; None where it knows all of the map.
    """

    vehicle: VehicleState
    history: History
    world: jax.Array
    goal: jax.Array
    route: jax.Array
    action: jax.Array
    stalled: jax.Array
    ending: jax.Array
    variation: Variation
    belief: MapBelief | None = None


@struct.dataclass(kw_only=True)
class NavigationParams(environment.EnvParams):
    """What an environment is run with: arrays, so that nothing here is compiled in.

    dynamics: the model's parameters.
    terrain: all worlds; routes: to all goals of the pool.
    starts, start_observation: leaves `[P, ...]` and `[P, O]`, the pool that resets draw from.
    max_steps_in_episode: `[]` int32.
    """

    dynamics: Params
    terrain: TerrainMap
    routes: Routes
    starts: NavigationState
    start_observation: jax.Array

    @property
    def pool_size(self) -> int:
        """P, the number of starts."""
        return self.start_observation.shape[0]

    def cost_to_go(self, state: NavigationState) -> jax.Array:
        """`[]` m of level ground that the way to the goal costs from where the vehicle is."""
        routes, position = self.routes.select(state.route), state.vehicle.position
        return routes.cost_to_go(self.terrain, position[:2])

    def believed(self, state: NavigationState) -> TerrainMap:
        """The world of an episode as far as its vehicle has seen it: what may drive it by."""
        terrain = self.terrain.select(state.world)
        if state.belief is None:
            return terrain
        return dataclasses.replace(terrain, belief=state.belief)


@dataclasses.dataclass(frozen=True)
class NavigationEnv(environment.Environment[NavigationState, NavigationParams]):
    """Drives to a goal with actions in [-1, 1]^2, speed and steering, at 10 Hz.

    Two environments of equal `dynamics`, `config` and `variation` are equal and share compiled
    code. There are no default parameters: a ground must be chosen, see `make_params`.
    """

    dynamics: Dynamics
    config: NavigationConfig = dataclasses.field(default_factory=NavigationConfig)
    variation: VariationConfig = VariationConfig()

    def __post_init__(self) -> None:
        chassis = self.config.chassis
        reach = float(np.hypot(chassis.wheelbase, chassis.track)) / 2
        top_speed = max(abs(speed) for speed in self.config.speed_range)
        crop.footprint_covered(reach, top_speed)

    def make_params(self, dynamics: Params, terrain: TerrainMap, tasks: Tasks) -> NavigationParams:
        """Parameters whose pool of starts is `tasks`, each settled on the ground by the model.

        `ValueError` names the first task that cannot be driven, or whose settled state is not
        finite.
        """
        return _make_params(self, dynamics, terrain, tasks)

    def shapes(self, dynamics: Params, terrain: TerrainMap, tasks: Tasks) -> NavigationParams:
        """What `make_params` gives, but for the starts, of which only shapes are known.

        Enough to restore what was learned with such parameters, or to compile what will be, without
        settling anything. Tasks that cannot be driven raise as there.
        """
        _check(self, terrain, tasks)
        routes = route.straight(self.config.route, terrain, tasks.goal)
        together, numbered = _settling(tasks)
        some = jax.tree.map(lambda x: x[:together], numbered)
        # As they will settle, so that it is traced only once.
        shapes = devices.shapes(partial(_settle, self), together)
        starts, seen = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((len(tasks.world), *x.shape[1:]), x.dtype),
            shapes(dynamics, terrain, routes, *some),
        )
        return _params(self, dynamics, terrain, routes, starts, seen)

    def start(
        self, params: NavigationParams, index: jax.Array
    ) -> tuple[jax.Array, NavigationState]:
        """Observation and state of start `[]` of the pool."""
        return jax.tree.map(lambda x: x[index], (params.start_observation, params.starts))

    def reset_env(
        self, key: jax.Array, params: NavigationParams
    ) -> tuple[jax.Array, NavigationState]:
        """A start drawn evenly from the pool, and how the episode varies."""
        seen, state = self.start(params, jax.random.randint(key, (), 0, params.pool_size))
        variation = Variation.draw(self.variation, jax.random.fold_in(key, 1), state.action)
        return seen, dataclasses.replace(state, variation=variation)

    def step_env(
        self,
        key: jax.Array,
        state: NavigationState,
        action: int | float | jax.Array,
        params: NavigationParams,
    ) -> tuple[jax.Array, NavigationState, jax.Array, jax.Array, dict[Any, Any]]:
        """One step of 0.1 s; a state that diverged is replaced by the last plausible one.

        An episode that is over stays as it is, and gives no reward. Only its history goes on, and
        what is on its way to the vehicle: to keep that, all would be copied in every step.
        """
        config = self.config
        terrain = params.terrain.select(state.world)
        action = jnp.clip(jnp.asarray(action, jnp.float32), -1.0, 1.0)
        arriving, variation = state.variation.arriving(action)
        ground, command = state.variation.ground(terrain), config.command(arriving)
        moved, history = self.dynamics.step(
            params.dynamics, ground, state.history, state.vehicle, command
        )
        running = state.ending == Ending.RUNNING
        apart = disagreement(history)
        plausible = self._is_plausible(terrain, moved, apart)
        vehicle, action = jax.tree.map(
            lambda new, old: jnp.where(running & plausible, new, old),
            (moved, action),
            (state.vehicle, state.action),
        )

        speed = jnp.linalg.norm(vehicle.velocity[:2])
        is_stalled = speed < config.stalled_speed
        stalled = jnp.where(is_stalled, state.stalled + running, 0)
        time = jnp.int32(state.time) + running
        distance, _ = observation.distance_and_bearing(vehicle.position, state.goal)
        roll, pitch, yaw = vehicle.rpy
        xy = vehicle.position[:2]
        chassis = config.chassis
        ending = first_ending(
            {
                Ending.TIMED_OUT: time >= params.max_steps_in_episode,
                Ending.GOAL: distance < config.goal_radius,
                Ending.STUCK: stalled * STEP_SECONDS >= config.stuck_seconds,
                Ending.COLLIDED: obstacles.collides(
                    terrain, xy, yaw, chassis.length, chassis.width
                ),
                Ending.OFF_MAP: edge_distance(terrain, xy) < config.map_margin,
                Ending.ROLLED_OVER: jnp.maximum(jnp.abs(roll), jnp.abs(pitch))
                > config.rollover_angle,
                Ending.DIVERGED: ~plausible,
            }
        )
        ending = jnp.where(running, ending, state.ending)
        climb = vehicle.position[2] - state.vehicle.position[2]
        left = params.cost_to_go(state)
        gain = reward(
            config.reward,
            progress=left - params.cost_to_go(dataclasses.replace(state, vehicle=vehicle)),
            distance=distance,
            stalled=is_stalled,
            roll=roll,
            pitch=pitch,
            vertical_speed=climb / STEP_SECONDS,
            disagreement=jnp.where(plausible, apart, 0.0),
            spread=jnp.where(plausible, spread(history), 0.0),
            ending=ending,
        )
        gain = jnp.where(running, gain, 0.0)
        belief = state.belief
        if belief is not None:
            seen = reveal.look(config.reveal, terrain, belief, vehicle.position, yaw)
            belief = jax.tree.map(partial(jnp.where, running), seen, belief)
        new = dataclasses.replace(
            state,
            vehicle=vehicle,
            history=history,
            action=action,
            time=time,
            stalled=stalled,
            ending=ending,
            variation=variation,
            belief=belief,
        )
        info = {
            "ending": ending,
            "abs_roll": jnp.abs(roll),
            "abs_pitch": jnp.abs(pitch),
            "distance": distance,
        }
        return self.observe(key, new, action, params), new, gain, is_terminal(ending), info

    def observe(
        self,
        key: jax.Array | None,
        state: NavigationState,
        action: int | float | jax.Array | None,
        params: NavigationParams,
    ) -> jax.Array:
        """`[O]` float32, see `observation.observe`, and the model's embedding of the ground."""
        del key, action
        routes = params.routes.select(state.route)
        return self._see(params.believed(state), routes, state)

    def is_terminated(self, state: NavigationState, params: NavigationParams) -> jax.Array:
        """Whether the task itself is over."""
        return is_terminal(state.ending)

    def is_truncated(self, state: NavigationState, params: NavigationParams) -> jax.Array:
        """Whether only the time is over: the value of the state that follows still counts."""
        return state.ending == Ending.TIMED_OUT

    @property
    def num_actions(self) -> int:
        """Speed and steering."""
        return 2

    def action_space(self, params: NavigationParams | None = None) -> spaces.Box:
        """[-1, 1]^2."""
        return spaces.Box(-1.0, 1.0, (2,), jnp.float32)

    def observation_space(self, params: NavigationParams | None = None) -> spaces.Box:
        """Every entry within the observation's limit."""
        limit, size = observation.OBSERVATION_LIMIT, observation.OBSERVATION_SIZE
        size += math.prod(self.senses.image or (0,))
        return spaces.Box(-limit, limit, (size,), jnp.float32)

    @property
    def senses(self) -> Senses:
        """How networks should read observations."""
        return Senses(observation.ARCS, EMBEDDING_SHAPE if self.config.embeddings else None)

    def _see(self, terrain: TerrainMap, routes: Routes, state: NavigationState) -> jax.Array:
        chassis, vehicle = self.config.chassis, state.vehicle
        seen = observation.observe(terrain, chassis, vehicle, state.goal, routes, state.action)
        if not self.config.embeddings:
            return seen
        return observation.with_embedding(seen, embedding(state.history))

    def _is_plausible(
        self, terrain: TerrainMap, vehicle: VehicleState, apart: jax.Array
    ) -> jax.Array:
        off_ground = vehicle.position[2] - query.height(terrain, vehicle.position[:2])
        return (
            jnp.all(jnp.isfinite(vehicle.vector))
            & (jnp.linalg.norm(vehicle.velocity) <= self.config.plausible_speed)
            & (jnp.abs(off_ground) <= self.config.plausible_height)
            & (apart <= self.config.plausible_disagreement)
        )


def _make_params(
    env: NavigationEnv, dynamics: Params, terrain: TerrainMap, pool: Tasks
) -> NavigationParams:
    config = env.config
    _check(env, terrain, pool)
    if config.reveal.partial:
        routes = route.straight(config.route, terrain, pool.goal)
    else:
        routes = route.plan(config.route, terrain, config.chassis, pool.world, pool.goal)
    together, numbered = _settling(pool)
    settle = devices.shared_out(partial(_settle, env), together)
    starts, start_observation = devices.in_turns(
        lambda some: settle(dynamics, terrain, routes, *some), numbered, together
    )
    finite = np.all(np.isfinite(starts.vehicle.vector), axis=-1)
    if not finite.all():
        i = int(np.argmin(finite))
        raise ValueError(
            f"dynamics: expected a finite state after {config.settle_steps} steps of standing "
            f"still, found {np.asarray(starts.vehicle.vector)[i]} in task {i} (world "
            f"{int(pool.world[i])}, start {np.asarray(pool.start)[i].tolist()}); "
            f"{np.sum(~finite)} of {finite.size} tasks are so"
        )
    return _params(env, dynamics, terrain, routes, starts, start_observation)


def _check(env: NavigationEnv, terrain: TerrainMap, pool: Tasks) -> None:
    """`ValueError` names what cannot be revealed, or the first task that cannot be driven."""
    reveal.check(env.config.reveal, terrain)
    tasks.validate(pool, terrain, env.config.goal_radius, env.config.map_margin)


def _settling(pool: Tasks) -> tuple[int, tuple[Tasks, jax.Array]]:
    """How many vehicles settle at a time, and all tasks with the numbers of their routes."""
    # Not all at once: patches of thousands of vehicles fill gigabytes.
    together = min(_SETTLED_TOGETHER * jax.device_count(), len(pool.world))
    return together, (pool, jnp.arange(len(pool.world)))


def _params(
    env: NavigationEnv,
    dynamics: Params,
    terrain: TerrainMap,
    routes: Routes,
    starts: NavigationState,
    start_observation: jax.Array,
) -> NavigationParams:
    return NavigationParams(
        max_steps_in_episode=jnp.int32(round(env.config.horizon_seconds / STEP_SECONDS)),
        dynamics=dynamics,
        terrain=terrain,
        routes=routes,
        starts=starts,
        start_observation=start_observation,
    )


@partial(jax.jit, static_argnames="env", compiler_options=devices.BRIEF)
def _settle(
    env: NavigationEnv,
    dynamics: Params,
    terrain: TerrainMap,
    routes: Routes,
    pool: Tasks,
    numbers: jax.Array,
) -> tuple[NavigationState, jax.Array]:
    """States and observations of vehicles at rest, leaves `[P, ...]` and `[P, O]`; numbers `[P]`
    are of their routes."""
    standing = Command(jnp.float32(0), jnp.float32(0))
    action = env.config.action(standing)

    def settle(
        dynamics: Params, terrain: TerrainMap, routes: Routes, task: Tasks, number: jax.Array
    ) -> tuple[NavigationState, jax.Array]:
        selected = terrain.select(task.world)
        vehicle = tasks.place(selected, env.config.chassis, task.start, task.yaw)
        goal = jnp.append(task.goal, query.height(selected, task.goal))

        def advance(
            carry: tuple[VehicleState, History], _: None
        ) -> tuple[tuple[VehicleState, History], None]:
            vehicle, history = carry
            return env.dynamics.step(dynamics, selected, history, vehicle, standing), None

        carry = vehicle, env.dynamics.init(dynamics, selected, vehicle)
        (vehicle, history), _ = jax.lax.scan(advance, carry, length=env.config.settle_steps)
        zero = jnp.int32(0)
        state = NavigationState(
            time=zero,
            vehicle=vehicle,
            history=history,
            world=task.world,
            goal=goal,
            route=number,
            action=action,
            stalled=zero,
            ending=zero,
            variation=Variation.draw(env.variation, jax.random.key(0), action),
            belief=reveal.begin(env.config.reveal, selected, vehicle.position, vehicle.rpy[2]),
        )
        believed = dataclasses.replace(selected, belief=state.belief)
        return state, env._see(believed, routes.select(number), state)

    each = devices.spread(settle, (None, None, None, 0, 0))
    return each(dynamics, terrain, routes, pool, numbers)
