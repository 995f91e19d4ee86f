"""Starts of episodes: vehicles placed on the ground, settled by the model, routes planned."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax import machine, parallel, xla
from vertiwm_jax.dynamics import Dynamics, History, Params, step
from vertiwm_jax.env import route, tasks
from vertiwm_jax.env.randomization import DomainRandomization, RandomizationConfig
from vertiwm_jax.env.route import Routes
from vertiwm_jax.env.task import NavigationConfig, TaskParams, TaskState, see
from vertiwm_jax.env.tasks import TaskError, Tasks
from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.perception.features import Encoders
from vertiwm_jax.state import STEP_SECONDS, Command, VehicleState
from vertiwm_jax.terrain import patches, query, sensing
from vertiwm_jax.terrain.map import TerrainMap

_Placed = tuple[VehicleState, History]


@dataclasses.dataclass(frozen=True)
class ResetPool:
    """How the pool of starts of an environment is made; static.

    dynamics, config, variation: the environment's.
    """

    dynamics: Dynamics
    config: NavigationConfig
    variation: RandomizationConfig

    def settled(
        self,
        weights: Params,
        vehicle: Vehicle,
        encoders: Encoders | None,
        terrain: TerrainMap,
        pool: Tasks,
    ) -> TaskParams:
        """As `NavigationEnv.make_params`."""
        config = self.config
        self._check(vehicle, terrain, pool)
        if config.sensing.partial:
            routes = route.straight(config.route, terrain, pool.goal)
        else:
            routes = route.plan(config.route, terrain, vehicle, pool.world, pool.goal)
        together, numbered = _in_turns(pool)
        settle = parallel.shared_out(partial(_settle_once, self), together)
        states, seen = parallel.in_turns(
            lambda some: settle(weights, vehicle, encoders, terrain, routes, *some),
            numbered,
            together,
        )
        finite = np.all(np.isfinite(states.vehicle.vector), axis=-1)
        if not finite.all():
            i = int(np.argmin(finite))
            raise TaskError(
                f"dynamics: expected a finite state after {config.settle_steps} steps of standing "
                f"still, found {np.asarray(states.vehicle.vector)[i]} in task {i} (world "
                f"{int(pool.world[i])}, start {np.asarray(pool.start)[i].tolist()}); "
                f"{np.sum(~finite)} of {finite.size} tasks are so"
            )
        return self._params(weights, vehicle, encoders, terrain, routes, states, seen)

    def shapes(
        self,
        weights: Params,
        vehicle: Vehicle,
        encoders: Encoders | None,
        terrain: TerrainMap,
        pool: Tasks,
    ) -> TaskParams:
        """As `NavigationEnv.shapes`."""
        self._check(vehicle, terrain, pool)
        routes = route.straight(self.config.route, terrain, pool.goal)
        together, numbered = _in_turns(pool)
        some = jax.tree.map(lambda x: x[:together], numbered)
        # As they will settle, so that it is traced only once.
        shapes = parallel.shapes(partial(_settle, self), together)
        states, seen = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((len(pool.world), *x.shape[1:]), x.dtype),
            shapes(weights, vehicle, encoders, terrain, routes, *some),
        )
        return self._params(weights, vehicle, encoders, terrain, routes, states, seen)

    def _check(self, vehicle: Vehicle, terrain: TerrainMap, pool: Tasks) -> None:
        """`ValueError` names what cannot be seen, or the first task that cannot be driven."""
        reach = float(np.hypot(vehicle.wheelbase, vehicle.track)) / 2
        patches.footprint_covered(reach, max(map(abs, self.config.speed_range)))
        sensing.check(self.config.sensing, terrain)
        tasks.validate(pool, terrain, self.config.goal_radius, self.config.map_margin)

    def _params(
        self,
        weights: Params,
        vehicle: Vehicle,
        encoders: Encoders | None,
        terrain: TerrainMap,
        routes: Routes,
        states: TaskState,
        seen: jax.Array,
    ) -> TaskParams:
        return TaskParams(
            max_steps_in_episode=jnp.int32(round(self.config.horizon_seconds / STEP_SECONDS)),
            dynamics=weights,
            vehicle=jax.tree.map(jnp.asarray, vehicle),
            encoders=encoders,
            terrain=terrain,
            routes=routes,
            starts=states,
            start_observation=seen,
        )


def _in_turns(pool: Tasks) -> tuple[int, tuple[Tasks, jax.Array]]:
    """How many vehicles settle at a time, and all tasks with the numbers of their routes."""
    # Not all at once: patches of thousands of vehicles fill gigabytes.
    of_device = machine.together(cpu=64, accelerator=1024)
    together = min(of_device * jax.device_count(), len(pool.world))
    return together, (pool, jnp.arange(len(pool.world)))


@partial(jax.jit, static_argnames="starts")
def _settle(
    starts: ResetPool,
    dynamics: Params,
    vehicle: Vehicle,
    encoders: Encoders | None,
    terrain: TerrainMap,
    routes: Routes,
    pool: Tasks,
    numbers: jax.Array,
) -> tuple[TaskState, jax.Array]:
    """States and observations of vehicles at rest, leaves `[P, ...]` and `[P, O]`; numbers `[P]`
    are of their routes."""
    model, config = starts.dynamics, starts.config

    def standing() -> Command:
        # Made where it is used: from outside of what devices share, it would be another type.
        return Command(jnp.float32(0), jnp.float32(0))

    def settle(dynamics: Params, vehicle: Vehicle, terrain: TerrainMap, task: Tasks) -> _Placed:
        selected = terrain.select(task.world)
        state = place(selected, task.start, task.yaw, vehicle=vehicle)
        return state, model.init(dynamics, selected, state)

    def stand(dynamics: Params, terrain: TerrainMap, world: jax.Array, placed: _Placed) -> _Placed:
        state, history = placed
        return step(model, dynamics, terrain.select(world), history, state, standing())

    def start(
        vehicle: Vehicle,
        encoders: Encoders | None,
        terrain: TerrainMap,
        routes: Routes,
        task: Tasks,
        number: jax.Array,
        settled: _Placed,
    ) -> tuple[TaskState, jax.Array]:
        at_rest, history = settled
        selected = terrain.select(task.world)
        zero, action = jnp.int32(0), vehicle.action(standing(), config.speed_range)
        state = TaskState(
            time=zero,
            vehicle=at_rest,
            history=history,
            world=task.world,
            goal=jnp.append(task.goal, query.height(selected, task.goal)),
            route=number,
            action=action,
            stalled=zero,
            ending=zero,
            variation=DomainRandomization.draw(starts.variation, jax.random.key(0), action),
            observed=sensing.init(config.sensing, selected, at_rest.position, at_rest.rpy[2]),
        )
        observed_map = dataclasses.replace(selected, observed=state.observed)
        return state, see(config, observed_map, vehicle, routes.select(number), state, encoders)

    placed = parallel.vmap(settle, (None, None, None, 0))(dynamics, vehicle, terrain, pool)
    # Steps of all, and not all steps of each: inside of `vmap`, a scan is traced again until it is
    # known what of a history differs between vehicles.
    stand_all = partial(parallel.vmap(stand, (None, None, 0, 0)), dynamics, terrain, pool.world)
    settled, _ = jax.lax.scan(
        lambda placed, _: (stand_all(placed), None), placed, length=config.settle_steps
    )
    start_all = parallel.vmap(start, (None, None, None, None, 0, 0, 0))
    return start_all(vehicle, encoders, terrain, routes, pool, numbers, settled)


# Apart, for what is traced inside of something else, as for its shapes, has no compiler options.
_settle_once = xla.brief_jit(_settle, static_argnames="starts")
