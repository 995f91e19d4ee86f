"""What goal navigation asks, where an episode of it stands, and what all of them are run with."""

import dataclasses

import jax
import numpy as np
from flax import struct

from vertiwm_jax.config import CountOrZero, settings
from vertiwm_jax.dynamics import History, Params
from vertiwm_jax.env import route
from vertiwm_jax.env._gymnax import EnvParams, EnvState
from vertiwm_jax.env.observation import ObservationSpec
from vertiwm_jax.env.randomization import DomainRandomization
from vertiwm_jax.env.reward import RewardConfig
from vertiwm_jax.env.route import RouteConfig, Routes
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.perception.features import Encoders
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain.map import ObservedMap, TerrainMap
from vertiwm_jax.terrain.sensing import SensingConfig


@settings
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
    arcs: whether an observation shows the ground along arcs ahead, and what the way to the goal
        costs from there; if not, that way is a straight line.
    embeddings: whether an observation ends with the ground as a Transformer's encoders see it.
    route: how the way to the goal is found; it is straight where the map is not all known.
    sensing: what sensors see of a map that is unknown at first, and its errors; by default all of
        it is known as it is.
    """

    goal_radius: float = 8.0
    horizon_seconds: float = 60.0
    speed_range: tuple[float, float] = (0.0, 5.0)
    map_margin: float = 1.0
    rollover_angle: float = np.pi / 3
    stalled_speed: float = 0.3
    stuck_seconds: float = 5.0
    plausible_speed: float = 30.0
    plausible_height: float = 4.0
    plausible_disagreement: float = np.inf
    settle_steps: CountOrZero = 15
    arcs: bool = True
    embeddings: bool = False
    reward: RewardConfig = dataclasses.field(default_factory=RewardConfig)
    route: RouteConfig = RouteConfig()
    sensing: SensingConfig = SensingConfig()

    def check(self) -> None:
        for name in ("range", "missing", "height_noise", "displaced") if self.embeddings else ():
            expected, found = getattr(SensingConfig(), name), getattr(self.sensing, name)
            if found != expected:
                raise ValueError(
                    f"sensing.{name}: expected {expected:g} with embeddings, which show all of the "
                    f"map as it is, found {found:g}"
                )

    @property
    def observed(self) -> ObservationSpec:
        """What policies see."""
        return ObservationSpec(self.arcs, self.embeddings)

    @property
    def straight(self) -> bool:
        """Whether the way to the goal is a straight line."""
        return self.sensing.partial or not self.arcs

    def route_to(self, terrain: TerrainMap, vehicle: Vehicle, goal: jax.Array) -> Routes:
        """The vehicle's route to the goal `[2]`, m, in the selected world; can be compiled."""
        if self.straight:
            return route.straight(self.route, terrain, goal[None])
        return route.plan_one(self.route, terrain, vehicle, goal)


@struct.dataclass(kw_only=True)
class TaskState(EnvState):
    """One episode under way.

    vehicle, history: the model's.
    world: `[]` int32; goal: `[3]` m; route: `[]` int32, which of all routes leads there.
    action: `[2]` the last one, in [-1, 1].
    time: `[]` int32 steps done; stalled, backing: `[]` int32 steps stalled, and told to drive
        backwards, without a break.
    ending: `[]` int32 `TerminationReason` code.
    variation: how this episode differs from what the map says.
    observed: what the vehicle has seen of its world; None where it knows all of the map.
    """

    vehicle: VehicleState
    history: History
    world: jax.Array
    goal: jax.Array
    route: jax.Array
    action: jax.Array
    stalled: jax.Array
    backing: jax.Array
    ending: jax.Array
    variation: DomainRandomization
    observed: ObservedMap | None = None


@struct.dataclass(kw_only=True)
class TaskParams(EnvParams):
    """What an environment is run with: arrays, so that nothing here is compiled in.

    dynamics: the model's parameters. vehicle: what drives; its model should know the same.
    terrain: all worlds; routes: to all goals of the pool.
    starts, start_observation: leaves `[P, ...]` and `[P, O]`, the pool that resets draw from, by
        `NavigationEnv.start`.
    max_steps_in_episode: `[]` int32.
    encoders: by which policies see the ground, where the model's histories do not have that.
    """

    dynamics: Params
    vehicle: Vehicle
    terrain: TerrainMap
    routes: Routes
    starts: TaskState
    start_observation: jax.Array
    encoders: Encoders | None = None

    @property
    def pool_size(self) -> int:
        """P, the number of starts."""
        return self.start_observation.shape[0]

    def cost_to_go(self, state: TaskState) -> jax.Array:
        """`[]` m of level ground that the way to the goal costs from where the vehicle is."""
        routes, position = self.routes.select(state.route), state.vehicle.position
        return routes.cost_to_go(self.terrain, position[:2])

    def observed_map(self, state: TaskState) -> TerrainMap:
        """The world of an episode as far as its vehicle has seen it; agents may read this one."""
        terrain = self.terrain.select(state.world)
        if state.observed is None:
            return terrain
        return dataclasses.replace(terrain, observed=state.observed)
