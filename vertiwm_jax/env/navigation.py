"""Goal navigation over any vehicle model, as a gymnax environment."""

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from gymnax.environments import environment, spaces

from vertiwm_jax.dynamics import Dynamics, Params, disagreement, spread, step
from vertiwm_jax.env import observation, suites
from vertiwm_jax.env.randomization import DomainRandomization, RandomizationConfig
from vertiwm_jax.env.resets import ResetPool
from vertiwm_jax.env.reward import reward
from vertiwm_jax.env.suites import GroundConfig
from vertiwm_jax.env.task import NavigationConfig, TaskParams, TaskState, see
from vertiwm_jax.env.tasks import Tasks
from vertiwm_jax.env.termination import TerminationReason, edge_distance, first_ending, is_terminal
from vertiwm_jax.mechanics.vehicle import HMMWV, Vehicle, load_vehicle
from vertiwm_jax.models.registry import Imagined, load_encoders, load_model
from vertiwm_jax.perception.features import Encoders
from vertiwm_jax.state import STEP_SECONDS, VehicleState
from vertiwm_jax.terrain import obstacles, query, sensing
from vertiwm_jax.terrain.map import TerrainMap


@dataclasses.dataclass(frozen=True)
class NavigationEnv(environment.Environment[TaskState, TaskParams]):
    """Drives to a goal with actions in [-1, 1]^2, speed and steering, at 10 Hz.

    Two environments of equal `dynamics`, `config` and `variation` are equal and share compiled
    code. There are no default parameters: a ground must be chosen, see `make_params`.
    """

    dynamics: Dynamics
    config: NavigationConfig = dataclasses.field(default_factory=NavigationConfig)
    variation: RandomizationConfig = RandomizationConfig()

    def make_params(
        self,
        dynamics: Params,
        terrain: TerrainMap,
        tasks: Tasks,
        vehicle: Vehicle | None = None,
        encoders: Encoders | None = None,
    ) -> TaskParams:
        """Parameters whose pool of starts is `tasks`, each settled on the ground by the model.

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
        return self._pool.settled(dynamics, vehicle or load_vehicle(), encoders, terrain, tasks)

    def shapes(
        self,
        dynamics: Params,
        terrain: TerrainMap,
        tasks: Tasks,
        vehicle: Vehicle | None = None,
        encoders: Encoders | None = None,
    ) -> TaskParams:
        """What `make_params` gives, but for the starts, of which only shapes are known.

        Enough to restore what was learned with such parameters, or to compile what will be, without
        settling anything. Tasks that cannot be driven raise as there.
        """
        return self._pool.shapes(dynamics, vehicle or load_vehicle(), encoders, terrain, tasks)

    def start(self, params: TaskParams, index: jax.Array) -> tuple[jax.Array, TaskState]:
        """Observation and state of start `[]` of the pool."""
        return jax.tree.map(lambda x: x[index], (params.start_observation, params.starts))

    def reset_env(self, key: jax.Array, params: TaskParams) -> tuple[jax.Array, TaskState]:
        """A start drawn evenly from the pool, and how the episode varies."""
        seen, state = self.start(params, jax.random.randint(key, (), 0, params.pool_size))
        variation = DomainRandomization.draw(
            self.variation, jax.random.fold_in(key, 1), state.action
        )
        return seen, dataclasses.replace(state, variation=variation)

    def step_env(
        self,
        key: jax.Array,
        state: TaskState,
        action: int | float | jax.Array,
        params: TaskParams,
    ) -> tuple[jax.Array, TaskState, jax.Array, jax.Array, dict[Any, Any]]:
        """One step of 0.1 s; a state that diverged is replaced by the last plausible one.

        An episode that is over stays as it is, and gives no reward. Only its history goes on, and
        what is on its way to the vehicle: to keep that, all would be copied in every step.
        """
        config = self.config
        terrain = params.terrain.select(state.world)
        action = jnp.clip(jnp.asarray(action, jnp.float32), -1.0, 1.0)
        arriving, variation = state.variation.arriving(action)
        ground, command = (
            state.variation.ground(terrain),
            params.vehicle.command(arriving, config.speed_range),
        )
        moved, history = step(
            self.dynamics, params.dynamics, ground, state.history, state.vehicle, command
        )
        running = state.ending == TerminationReason.RUNNING
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
        size = params.vehicle.length, params.vehicle.width
        ending = first_ending(
            {
                TerminationReason.TIMED_OUT: time >= params.max_steps_in_episode,
                TerminationReason.GOAL: distance < config.goal_radius,
                TerminationReason.STUCK: stalled * STEP_SECONDS >= config.stuck_seconds,
                TerminationReason.COLLIDED: obstacles.collides(terrain, xy, yaw, *size),
                TerminationReason.OFF_MAP: edge_distance(terrain, xy) < config.map_margin,
                TerminationReason.ROLLED_OVER: jnp.maximum(jnp.abs(roll), jnp.abs(pitch))
                > config.rollover_angle,
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
            roll=roll,
            pitch=pitch,
            vertical_speed=climb / STEP_SECONDS,
            disagreement=jnp.where(plausible, apart, 0.0),
            spread=jnp.where(plausible, spread(history), 0.0),
            ending=ending,
        )
        gain = jnp.where(running, gain, 0.0)
        observed = state.observed
        if observed is not None:
            seen = sensing.update(config.sensing, terrain, observed, vehicle.position, yaw)
            observed = jax.tree.map(partial(jnp.where, running), seen, observed)
        new = dataclasses.replace(
            state,
            vehicle=vehicle,
            history=history,
            action=action,
            time=time,
            stalled=stalled,
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
        return self.observe(key, new, action, params), new, gain, is_terminal(ending), info

    def observe(
        self,
        key: jax.Array | None,
        state: TaskState,
        action: int | float | jax.Array | None,
        params: TaskParams,
    ) -> jax.Array:
        """`[O]` float32, see `observation.observe`, and the ground as encoders see it."""
        del key, action
        routes = params.routes.select(state.route)
        terrain = params.observed_map(state)
        return see(self.config, terrain, params.vehicle, routes, state, params.encoders)

    def is_terminated(self, state: TaskState, params: TaskParams) -> jax.Array:
        """Whether the task itself is over."""
        return is_terminal(state.ending)

    def is_truncated(self, state: TaskState, params: TaskParams) -> jax.Array:
        """Whether only the time is over: the value of the state that follows still counts."""
        return state.ending == TerminationReason.TIMED_OUT

    def action_space(self, params: TaskParams | None = None) -> spaces.Box:
        """[-1, 1]^2."""
        return spaces.Box(-1.0, 1.0, (2,), jnp.float32)

    def observation_space(self, params: TaskParams | None = None) -> spaces.Box:
        """Every entry within the observation's limit."""
        limit, size = observation.OBSERVATION_LIMIT, self.config.observed.size
        return spaces.Box(-limit, limit, (size,), jnp.float32)

    @property
    def _pool(self) -> ResetPool:
        return ResetPool(self.dynamics, self.config, self.variation)

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


def make_env(
    terrain: TerrainMap | None = None,
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
        terrain: W worlds; by default two procedural ones of each suite that policies are tested on.
        model: what moves the vehicle, see `load_model`.
        vehicle: a vehicle, the name of one that comes along, or a YAML file of one; learned models
            move the one that they were fitted to.
        weights: folder of a fitted model; the one that comes along by default.
        config: what the task asks.
        pairs: tasks in a world, each from one point of a circle to the opposite one.
        seed: draws the default worlds.

    Returns:
        The environment, and its parameters with a pool of W * `pairs` starts, each settled on the
        ground by the model. `reset(key, params)` gives an observation `[O]` and a state, and
        `step(key, state, action, params)` with an action `[2]` in [-1, 1] the next ones, the
        reward, whether the episode is over, and `info`.

    Raises:
        TaskError: a task cannot be driven on the map.
        ConfigError, CheckpointError: there is no such vehicle, or no such model.
    """
    driven = load_vehicle(vehicle) if isinstance(vehicle, str) else vehicle
    if terrain is None:
        terrain = suites.suite_worlds(GroundConfig(suite_worlds=2), jax.random.key(seed))
    dynamics, params = load_model(model, weights, vehicle=driven, embeddings=config.embeddings)
    env = NavigationEnv(dynamics, config)
    encoders = load_encoders(weights) if config.embeddings else None
    tasks = suites.test_tasks(GroundConfig(pairs=pairs), terrain)
    return env, env.make_params(params, terrain, tasks, driven, encoders)
