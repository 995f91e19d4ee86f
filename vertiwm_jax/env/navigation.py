"""Goal navigation over any vehicle model, as a gymnax environment."""

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax import kept, machine, parallel
from vertiwm_jax.dynamics import (
    Dynamics,
    History,
    Params,
    disagreement,
    embedding,
    rutted,
    spread,
    step,
)
from vertiwm_jax.env import observation, route, suites
from vertiwm_jax.env._gymnax import Box, Environment
from vertiwm_jax.env.agent import Policy, corrected
from vertiwm_jax.env.randomization import DomainRandomization, RandomizationConfig
from vertiwm_jax.env.reward import reward
from vertiwm_jax.env.suites import GroundConfig, TaskError, Tasks, validate
from vertiwm_jax.env.task import NavigationConfig, TaskParams, TaskState
from vertiwm_jax.env.termination import TerminationReason, edge_distance, first_ending, is_terminal
from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import HMMWV, Vehicle, load_vehicle
from vertiwm_jax.models.registry import Imagined, load_encoders, load_model
from vertiwm_jax.networks.transformer import KeyValueCache
from vertiwm_jax.perception.features import Encoders
from vertiwm_jax.perception.perceive import embed
from vertiwm_jax.precision import float32
from vertiwm_jax.state import STEP_SECONDS, Command, VehicleState
from vertiwm_jax.terrain import obstacles, patches, query, sensing
from vertiwm_jax.terrain.files import load_map
from vertiwm_jax.terrain.map import TerrainMap, expect_room

T = TypeVar("T")
_Placed = tuple[VehicleState, History]


@dataclasses.dataclass(frozen=True)
class NavigationEnv(Environment[TaskState, TaskParams]):
    """Drives to a goal with actions in [-1, 1]^2, speed and steering, at 10 Hz.

    Two environments of equal fields are equal and share compiled code. There are no default
    parameters: a ground must be chosen, see `make_params`.

    action_repeat: steps of 0.1 s for which an action is held. Exploration noise that lasts moves a
        vehicle, where noise that changes at every step only shakes it, and there are fewer
        decisions to assign credit to (Mnih et al., 2015).
    base: a controller that acts at every step. The held action, in [-1, 1], is added to its action
        (Silver et al., 2018, "Residual policy learning").
    settling: in which starts come to rest; in the model itself by default, which takes longer if
        that has learned weights.
    """

    dynamics: Dynamics
    config: NavigationConfig = dataclasses.field(default_factory=NavigationConfig)
    variation: RandomizationConfig = RandomizationConfig()
    action_repeat: int = 1
    base: Policy | None = None
    settling: Simulator | None = None

    @float32
    def make_params(
        self,
        dynamics: Params,
        terrain: TerrainMap,
        tasks: Tasks,
        vehicle: Vehicle | None = None,
        encoders: Encoders | None = None,
    ) -> TaskParams:
        """Parameters whose pool of starts is `tasks`, each settled on the ground.

        Args:
            dynamics: the model's parameters.
            terrain: the worlds.
            tasks: on these worlds.
            vehicle: what the model moves; an HMMWV by default.
            encoders: by which policies see the ground, where the model does not keep what it sees.

        Raises:
            ValueError: names the first task that cannot be driven, or whose settled state is not
                finite.
        """
        config, vehicle, pool = self.config, vehicle or load_vehicle(), len(tasks.world)
        reach = float(np.hypot(vehicle.wheelbase, vehicle.track) / 2)
        patches.footprint_covered(reach, max(map(abs, config.speed_range)))
        sensing.check(config.sensing, terrain)
        validate(tasks, terrain, config.goal_radius, config.map_margin)
        if config.straight:
            routes = route.straight(config.route, terrain, tasks.goal)
        else:
            routes = route.plan(config.route, terrain, vehicle, tasks.world, tasks.goal)
        params = TaskParams(
            max_steps_in_episode=jnp.int32(round(config.horizon_seconds / STEP_SECONDS)),
            dynamics=dynamics,
            vehicle=jax.tree.map(jnp.asarray, vehicle),
            encoders=encoders,
            terrain=terrain,
            routes=routes,
            starts=cast(TaskState, ()),
            start_observation=cast(jax.Array, ()),
        )
        # Not all at once: patches of thousands of vehicles fill gigabytes.
        of_device = machine.together(cpu=64, accelerator=1024)
        together = min(of_device * jax.device_count(), pool)
        settle = parallel.shared_out(partial(_settle, self), together)
        numbered = tasks, jnp.arange(pool)
        starts, seen = parallel.in_turns(lambda x: settle(params, *x), numbered, together)
        states = np.asarray(starts.vehicle.vector)
        finite = np.isfinite(states).all(axis=-1)
        if not finite.all():
            i = int(np.argmin(finite))
            raise TaskError(
                f"dynamics: expected a finite state after {config.settle_steps} steps of "
                f"standing still, found {states[i]}; {tasks.told(i, terrain)}; "
                f"{np.sum(~finite)} of {pool} tasks are so"
            )
        return dataclasses.replace(params, starts=starts, start_observation=seen)

    def start(self, params: TaskParams, index: jax.Array) -> tuple[jax.Array, TaskState]:
        """Observation and state of start `[]` of the pool."""
        seen, state = jax.tree.map(lambda x: x[index], (params.start_observation, params.starts))
        return seen, _of_caches(state, _emptied) if self.settling else state

    @float32
    def reset_env(self, key: jax.Array, params: TaskParams) -> tuple[jax.Array, TaskState]:
        """A start drawn evenly from the pool, and how the episode varies."""
        seen, state = self.start(params, jax.random.randint(key, (), 0, params.pool_size))
        variation = DomainRandomization.draw(
            self.variation, jax.random.fold_in(key, 1), state.action
        )
        return seen, dataclasses.replace(state, variation=variation)

    @float32
    def step_env(
        self, key: jax.Array, state: TaskState, action: int | float | jax.Array, params: TaskParams
    ) -> tuple[jax.Array, TaskState, jax.Array, jax.Array, dict[Any, Any]]:
        """Holds an action for `action_repeat` steps, or until the episode ends; rewards add up.

        A state that diverged is replaced by the last plausible one. An episode that is over stays
        as it is, and gives no reward. Only its history goes on, and what is on its way to the
        vehicle: to keep that, all would be copied in every step.
        """
        if self.action_repeat == 1 and self.base is None:
            return self._step(state, action, params)

        def once(carry: tuple[jax.Array, TaskState], key: jax.Array) -> tuple:
            observation, state = carry
            acted = corrected(self.base, observation, key, jnp.asarray(action))
            observation, state, *result = self._step(state, acted, params)
            return (observation, state), result

        first = self.observe(key, state, None, params), state
        keys = jax.random.split(key, self.action_repeat)
        (observation, state), (rewards, terminated, info) = jax.lax.scan(once, first, keys)
        last = jax.tree.map(lambda x: x[-1], (terminated, info))
        return observation, state, jnp.sum(rewards), *last

    def _step(
        self, state: TaskState, action: int | float | jax.Array, params: TaskParams
    ) -> tuple[jax.Array, TaskState, jax.Array, jax.Array, dict[Any, Any]]:
        """One step of 0.1 s."""
        config = self.config
        terrain = params.terrain.select(state.world)
        action = jnp.clip(jnp.asarray(action, jnp.float32), -1.0, 1.0)
        arriving, variation = state.variation.arriving(action)
        ground = state.variation.ground(terrain)
        command = params.vehicle.command(arriving, config.speed_range)
        given = params.dynamics, ground, state.history, state.vehicle, command
        moved, history = step(self.dynamics, *given)
        running = state.ending == TerminationReason.RUNNING
        apart = disagreement(history)
        off_ground = moved.position[2] - query.height(terrain, moved.position[:2])
        plausible = (
            jnp.all(jnp.isfinite(moved.vector))
            & (jnp.linalg.norm(moved.velocity) <= config.plausible_speed)
            & (jnp.abs(off_ground) <= config.plausible_height)
            & (apart <= config.plausible_disagreement)
        )
        vehicle, action = jax.tree.map(
            lambda new, old: jnp.where(running & plausible, new, old),
            (moved, action),
            (state.vehicle, state.action),
        )

        speed = jnp.linalg.norm(vehicle.velocity[:2])
        is_stalled = speed < config.stalled_speed
        stalled = jnp.where(is_stalled, state.stalled + running, 0)
        held = params.vehicle.command(jnp.asarray(action), config.speed_range)
        backing = jnp.where(held.speed < 0, state.backing + running, 0)
        time = jnp.int32(state.time) + running
        distance, _ = observation.distance_and_bearing(vehicle.position, state.goal)
        (roll, pitch, yaw), xy = vehicle.rpy, vehicle.position[:2]
        tilt = jnp.maximum(jnp.abs(roll), jnp.abs(pitch))
        size = params.vehicle.length, params.vehicle.width
        ending = first_ending(
            {
                TerminationReason.TIMED_OUT: time >= params.max_steps_in_episode,
                TerminationReason.GOAL: distance < config.goal_radius,
                TerminationReason.STUCK: stalled * STEP_SECONDS >= config.stuck_seconds,
                TerminationReason.COLLIDED: obstacles.collides(terrain, xy, yaw, *size),
                TerminationReason.OFF_MAP: edge_distance(terrain, xy) < config.map_margin,
                TerminationReason.ROLLED_OVER: tilt > config.rollover_angle,
                TerminationReason.DIVERGED: ~plausible,
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
            tilt=vehicle.rpy[:2],
            vertical_speed=climb / STEP_SECONDS,
            disagreement=jnp.where(plausible, apart, 0.0),
            spread=jnp.where(plausible, spread(history), 0.0),
            ending=ending,
        )
        gain = jnp.where(running, gain, 0.0)
        observed = state.observed
        if observed is not None:
            known = params.observed_map(state)
            seen = sensing.look(config.sensing, known, vehicle.position, yaw)
            observed = jax.tree.map(partial(jnp.where, running), seen, observed)
        new = dataclasses.replace(
            state,
            vehicle=vehicle,
            history=history,
            action=action,
            time=time,
            stalled=stalled,
            backing=backing,
            ending=ending,
            variation=variation,
            observed=observed,
        )
        info = {
            "ending": ending,
            "abs_roll": jnp.abs(roll),
            "abs_pitch": jnp.abs(pitch),
            "distance": distance,
        }
        return self.observe(None, new, action, params), new, gain, is_terminal(ending), info

    @float32
    def observe(
        self,
        key: jax.Array | None,
        state: TaskState,
        action: int | float | jax.Array | None,
        params: TaskParams,
    ) -> jax.Array:
        """`[O]` float32, see `observation.observe`, and the ground as encoders see it.

        `ValueError` where there is nothing to see by.
        """
        del key, action
        terrain, latents = params.observed_map(state), None
        if self.config.embeddings:
            latents = embedding(state.history)
            if latents is None:
                if params.encoders is None:
                    raise ValueError(
                        "embeddings: expected a model that was loaded with them, or encoders to "
                        "see by, found neither; see models.registry.load_encoders"
                    )
                ground = rutted(terrain, state.history)
                latents = embed(params.encoders, ground, state.vehicle)
        waiting = STEP_SECONDS * jnp.stack([state.stalled, state.backing]).astype(jnp.float32)
        vehicle = state.vehicle
        if state.observed is not None:
            # Where the vehicle is on its map.
            position = vehicle.position.at[:2].add(state.observed.displaced)
            vehicle = dataclasses.replace(vehicle, position=position)
        seen = vehicle, state.goal, params.routes.select(state.route), state.action, waiting
        spec = self.config.observed
        return observation.observe(spec, terrain, params.vehicle, *seen, latents)

    def is_terminated(self, state: TaskState, params: TaskParams) -> jax.Array:
        """Whether the task itself is over."""
        return is_terminal(state.ending)

    def is_truncated(self, state: TaskState, params: TaskParams) -> jax.Array:
        """Whether only the time is over: the value of the state that follows still counts."""
        return state.ending == TerminationReason.TIMED_OUT

    def action_space(self, params: TaskParams | None = None) -> Box:
        """[-1, 1]^2."""
        return Box(-1.0, 1.0, (2,), jnp.float32)

    def observation_space(self, params: TaskParams | None = None) -> Box:
        """Every entry within the observation's limit."""
        limit, size = observation.OBSERVATION_LIMIT, self.config.observed.size
        return Box(-limit, limit, (size,), jnp.float32)


@partial(kept.jit, static_argnames="env")
def _settle(
    env: NavigationEnv, params: TaskParams, tasks: Tasks, numbers: jax.Array
) -> tuple[TaskState, jax.Array]:
    """States and observations of vehicles at rest, leaves `[P, ...]` and `[P, O]`.

    params: without starts; numbers: `[P]` int32, of the routes to the goals.
    """
    model, config = env.dynamics, env.config
    rests, constants = model, params.dynamics
    if env.settling:
        rests, constants = env.settling, chrono_like(params.vehicle)

    def standing() -> Command:
        # Made where it is used: from outside of what devices share, it would be another type.
        return Command(jnp.float32(0), jnp.float32(0))

    @partial(parallel.vmap, in_axes=(None, None, 0))
    def begin(params: TaskParams, constants: Params, task: Tasks) -> _Placed:
        terrain = params.terrain.select(task.world)
        state = place(terrain, task.start, task.yaw, vehicle=params.vehicle)
        return state, rests.init(constants, terrain, state)

    @partial(parallel.vmap, in_axes=(None, None, 0, 0))
    def stand(params: TaskParams, constants: Params, task: Tasks, placed: _Placed) -> _Placed:
        (state, history), terrain = placed, params.terrain.select(task.world)
        return step(rests, constants, terrain, history, state, standing())

    @partial(parallel.vmap, in_axes=(None, 0, 0, 0))
    def start(
        params: TaskParams, task: Tasks, number: jax.Array, placed: _Placed
    ) -> tuple[TaskState, jax.Array]:
        (vehicle, history), terrain = placed, params.terrain.select(task.world)
        if env.settling:
            history = model.init(params.dynamics, terrain, vehicle)
        action, zero = params.vehicle.action(standing(), config.speed_range), jnp.int32(0)
        seen = None
        if not config.sensing.exact:
            pose = vehicle.position, vehicle.rpy[2]
            seed = jax.lax.bitcast_convert_type(task.start, jnp.uint32).sum()
            seen = sensing.look(config.sensing, terrain, *pose, seed)
        state = TaskState(
            time=zero,
            vehicle=vehicle,
            history=history,
            world=task.world,
            goal=jnp.append(task.goal, query.height(terrain, task.goal)),
            route=number,
            action=action,
            stalled=zero,
            backing=zero,
            ending=zero,
            variation=DomainRandomization.draw(env.variation, jax.random.key(0), action),
            observed=seen,
        )
        seen = env.observe(None, state, None, params)
        return _of_caches(state, _left_out) if env.settling else state, seen

    # Steps of all, and not all steps of each: inside of `vmap`, a scan is traced again until it is
    # known what of a history differs between vehicles.
    at_rest, _ = jax.lax.scan(
        lambda placed, _: (stand(params, constants, tasks, placed), None),
        begin(params, constants, tasks),
        length=config.settle_steps,
    )
    return start(params, tasks, numbers, at_rest)


def _of_caches(tree: T, change: Callable[[jax.Array], jax.Array]) -> T:
    """The tree with a change to all arrays of its caches of past tokens."""

    def one(x: Any) -> Any:
        return jax.tree.map(change, x) if isinstance(x, KeyValueCache) else x

    return jax.tree.map(one, tree, is_leaf=lambda x: isinstance(x, KeyValueCache))


def _left_out(x: jax.Array) -> jax.Array:
    """Nothing of an empty cache but its shape: those of a pool would fill half a gigabyte."""
    return jnp.zeros((0, *x.shape), x.dtype)


def _emptied(x: jax.Array) -> jax.Array:
    """The empty cache that was left out."""
    return jnp.zeros(x.shape[1:], x.dtype)


@float32
def make_env(
    terrain: TerrainMap | str | Path | None = None,
    model: Imagined = "builtin",
    *,
    vehicle: str | Vehicle = HMMWV,
    weights: str | Path | None = None,
    config: NavigationConfig = NavigationConfig(),
    pairs: int = 10,
    seed: int = 0,
) -> tuple[NavigationEnv, TaskParams]:
    """Makes the task of driving across maps as an environment, a step of which is 0.1 s.

    Args:
        terrain: W worlds, or a map file, or a folder of maps; by default two procedural worlds of
            each suite that policies are tested on.
        model: what moves the vehicle, see `load_model`.
        vehicle: a vehicle, the name of a shipped one, or a YAML file of one; learned models
            move the one that they were fitted to.
        weights: folder of a fitted model; a shipped one by default, as `load_model` says.
        config: what the task asks.
        pairs: tasks in a world, each from one point of a circle to the opposite one.
        seed: draws the default worlds.

    Returns:
        The environment, and its parameters with a pool of W * `pairs` starts, each settled on the
        ground by the built-in simulator. `reset(key, params)` gives an observation `[O]` and a
        state, and `step(key, state, action, params)` with an action `[2]` in [-1, 1] the next
        ones, the reward, whether the episode is over, and `info`.

    Raises:
        MapError, TaskError: a map is too small, or a task on it cannot be driven.
        ConfigError, CheckpointError: there is no such vehicle, or no such model.
        UserError: this process was forked after JAX had started.
    """
    machine.refuse_forked()
    driven = load_vehicle(vehicle) if isinstance(vehicle, str) else vehicle
    dynamics, params = load_model(model, weights, vehicle=driven, embeddings=config.embeddings)
    env = NavigationEnv(dynamics, config, settling=None if model == "builtin" else Simulator())
    if terrain is None:
        terrain = suites.suite_worlds(GroundConfig(suite_worlds=2), jax.random.key(seed))
    elif not isinstance(terrain, TerrainMap):
        terrain = load_map(terrain, least=suites.SMALLEST)
    expect_room(terrain, suites.SMALLEST, "map")
    encoders = load_encoders(weights) if config.embeddings else None
    tasks = suites.test_tasks(GroundConfig(pairs=pairs), terrain)
    return env, env.make_params(params, terrain, tasks, driven, encoders)
