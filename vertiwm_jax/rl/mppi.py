"""Planning without a learned policy: model predictive path integral control."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.env.navigation import NavigationParams, NavigationState
from vertiwm_jax.env.observation import distance_and_bearing
from vertiwm_jax.rl.imagining import Future, Imagining, Plan, around
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.world_model.choice import ModelName


@dataclass(frozen=True)
class MPPIConfig:
    """What `MPPI` imagines before it decides, and what it makes of it."""

    candidates: int = 64
    """Plans compared at every decision; the first is what was intended anyway."""
    decisions: int = 6
    """Decisions in a plan."""
    interval: int = 8
    """Steps of 0.1 s that a decision is held."""
    spread: float = 0.5
    """Standard deviation of the other plans about it, in units of half the action range."""
    temperature: float = 30.0
    """Reward by which a plan must be worse to count e times less."""
    discount: float = 0.98
    """Of rewards, for each decision."""
    pace: float = 3.0
    """Speed, m/s, at which a vehicle is expected to go on to the goal where a plan ends."""
    model: ModelName = "nesam"
    """What it imagines in: NeSAM predicts as well as the whole Verti-WM, many times faster."""

    def __post_init__(self):
        for name in ("candidates", "decisions", "interval"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, found {getattr(self, name)}")
        if self.spread < 0:
            raise ValueError(f"spread: expected at least 0, found {self.spread}")
        for name in ("temperature", "pace"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}: expected more than 0, found {getattr(self, name)}")
        if not 0 < self.discount < 1:
            raise ValueError(f"discount: expected between 0 and 1, found {self.discount}")


@struct.dataclass
class MPPI(Imagining):
    """Drives by the mean of many imagined plans, weighed by what each of them returns.

    Plans are drawn about the one that was intended, moved on by a decision; each counts
    exp(return / temperature) times (Williams et al., 2017, "Information theoretic MPC for
    model-based reinforcement learning", without its cost of control). What it gives is intended
    then, and its first decision is driven. Returns are those of the task, whose episodes end in
    imagination as they do in truth, so that a plan that fails forgoes all that would have come.
    """

    config: MPPIConfig = struct.field(pytree_node=False, default=MPPIConfig())

    @property
    def interval(self) -> int:
        """Steps that a decision is held."""
        return self.config.interval

    @property
    def discount(self) -> float:
        """For each decision."""
        return self.config.discount

    @property
    def planned(self) -> int:
        """All that was intended is kept."""
        return self.config.decisions

    def decide(
        self,
        params: NavigationParams,
        memory: Plan,
        observation: jax.Array,
        state: NavigationState,
        key: jax.Array,
    ) -> Plan:
        """The plans' mean; what is intended after the last decision is the same again."""
        noise_key, key = jax.random.split(key)
        intended = jnp.concatenate([memory.corrections[1:], memory.corrections[-1:]])
        candidates = around(intended, self.config.candidates, self.config.spread, noise_key)
        returns = self.returns(params, memory, observation, state, candidates, key)
        weights = jax.nn.softmax(returns / self.config.temperature)
        return replace(memory, corrections=jnp.tensordot(weights, candidates, axes=1))

    def imagine(
        self,
        params: NavigationParams,
        observation: jax.Array,
        state: NavigationState,
        candidate: jax.Array,
        key: jax.Array,
    ) -> jax.Array:
        """The discounted return `[]` of a plan `[D, 2]` and of what is expected after it."""

        def advance(future: Future, inputs: tuple[jax.Array, jax.Array]) -> tuple[Future, None]:
            return self.hold(params, future, *inputs), None

        keys = jax.random.split(key, self.config.decisions)
        future, _ = jax.lax.scan(advance, Future.of(observation, state), (candidate, keys))
        return future.total + future.weight * self._expected(future.state)

    def _expected(self, state: NavigationState) -> jax.Array:
        """The discounted return `[]` of going straight on to the goal, at a steady pace."""
        reward, discount = self.env.config.reward, self.config.discount
        distance, _ = distance_and_bearing(state.vehicle.position, state.goal)
        left = jnp.maximum(distance - self.env.config.goal_radius, 0.0)
        stride = self.config.pace * self.config.interval * STEP_SECONDS
        at_goal = discount ** (left / stride)
        on_the_way = reward.progress * stride * (1 - at_goal) / (1 - discount)
        return on_the_way + reward.goal * at_goal
