"""Decision-time planning: a learned policy, improved by imagining what its actions lead to."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.dynamics import History, Params
from vertiwm_jax.env.driver import Driver
from vertiwm_jax.env.navigation import NavigationEnv, NavigationParams, NavigationState
from vertiwm_jax.env.repeat import ActionRepeat, Controller, corrected
from vertiwm_jax.rl.learned import MeanAction, TwinValue, Value
from vertiwm_jax.world_model.choice import ModelName


@dataclass(frozen=True)
class PlanningConfig:
    """How far a driver looks ahead before it decides."""

    candidates: int = 8
    """Actions compared at every decision; the first is what the policy does anyway."""
    decisions: int = 4
    """Decisions imagined of each: the candidate, then those of the policy."""
    spread: float = 0.4
    """Standard deviation of the other candidates about it, in units of half the action range."""
    model: ModelName = "nesam"
    """What it imagines in: NeSAM predicts as well as the whole Verti-WM, many times faster."""

    def __post_init__(self):
        for name in ("candidates", "decisions"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, found {getattr(self, name)}")
        if self.spread < 0:
            raise ValueError(f"spread: expected at least 0, found {self.spread}")


@struct.dataclass
class Plan:
    """What a `Planner` carries.

    history: of the model that it imagines in, along the way really driven.
    correction: `[2]` of the base, held until the next decision; the action itself without a base.
    """

    history: History
    correction: jax.Array


@struct.dataclass
class Planner(Driver):
    """Drives by the best of several imagined futures.

    Every decision is held for `interval` steps. Candidates are drawn about the policy's action;
    from each the model is rolled out with the policy deciding on, and what the critic expects
    where imagination ends is added to the rewards (Lowrey et al., 2019, "Plan online, learn
    offline"). The model needs not be the one that the vehicle really follows.

    env: the task inside the model, static; dynamics: the model's parameters.
    policy, value: as learned with this `interval` and base. discount: for each decision.
    """

    env: NavigationEnv = struct.field(pytree_node=False)
    dynamics: Params
    policy: MeanAction
    value: Value | TwinValue
    base: Controller | None = struct.field(pytree_node=False)
    interval: int = struct.field(pytree_node=False)
    discount: float = struct.field(pytree_node=False)
    config: PlanningConfig = struct.field(pytree_node=False, default=PlanningConfig())

    def start(self, params: NavigationParams, state: NavigationState) -> Plan:
        """The model's first history."""
        terrain = params.terrain.select(state.world)
        history = self.env.dynamics.init(self.dynamics, terrain, state.vehicle)
        return Plan(history, jnp.zeros(2))

    def decide(
        self,
        params: NavigationParams,
        memory: Plan,
        observation: jax.Array,
        state: NavigationState,
        key: jax.Array,
    ) -> Plan:
        """The first action of the best imagined future."""
        noise_key, key = jax.random.split(key)
        usual = self.policy(observation)
        noise = jax.random.normal(noise_key, (self.config.candidates, 2)).at[0].set(0.0)
        candidates = jnp.clip(usual + self.config.spread * noise, -1.0, 1.0)
        imagined = replace(params, dynamics=self.dynamics)
        state = replace(state, history=memory.history)
        returns = jax.vmap(self._imagine, (None, None, None, 0, None))(
            imagined, observation, state, candidates, key
        )
        return replace(memory, correction=candidates[jnp.argmax(returns)])

    def act(
        self,
        params: NavigationParams,
        memory: Plan,
        observation: jax.Array,
        state: NavigationState,
        key: jax.Array,
    ) -> tuple[jax.Array, Plan]:
        """The base, corrected as planned; the model's history follows the vehicle."""
        action = corrected(self.base, observation, key, memory.correction)
        terrain, command = params.terrain.select(state.world), self.env.config.command(action)
        _, history = self.env.dynamics.step(
            self.dynamics, terrain, memory.history, state.vehicle, command
        )
        return action, replace(memory, history=history)

    def _imagine(
        self,
        params: NavigationParams,
        observation: jax.Array,
        state: NavigationState,
        action: jax.Array,
        key: jax.Array,
    ) -> jax.Array:
        """The discounted return `[]` of one action and of what the policy makes of it."""
        env = ActionRepeat(self.env, self.interval, self.base)

        def advance(carry: tuple[Any, ...], key: jax.Array) -> tuple[tuple[Any, ...], None]:
            observation, state, action, weight, total = carry
            observation, state, reward, ended, _ = env.step_env(key, state, action, params)
            total = total + weight * reward
            ended = ended | env.is_truncated(state, params)
            weight = jnp.where(ended, 0.0, weight * self.discount)
            return (observation, state, self.policy(observation), weight, total), None

        keys = jax.random.split(key, self.config.decisions)
        carry = observation, state, action, jnp.float32(1), jnp.float32(0)
        (observation, _, _, weight, total), _ = jax.lax.scan(advance, carry, keys)
        return total + weight * self.value(observation)
