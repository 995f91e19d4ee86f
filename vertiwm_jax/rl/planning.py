"""Decision-time planning: a learned policy, improved by imagining what its actions lead to."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.config import Count, NotNegative, settings
from vertiwm_jax.env.action_repeat import Controller
from vertiwm_jax.env.agent import Now
from vertiwm_jax.models.registry import ModelName
from vertiwm_jax.rl.imagining import Future, Imagining, Plan, around
from vertiwm_jax.rl.learned import MeanAction, TwinValue, Value


@settings
class PlanningConfig:
    """How far a driver looks ahead before it decides."""

    candidates: Count = 8
    """Actions compared at every decision; the first is what the policy does anyway."""
    decisions: Count = 4
    """Decisions imagined of each: the candidate, then those of the policy."""
    spread: NotNegative = 0.4
    """Standard deviation of the other candidates about it, in units of half the action range."""
    model: ModelName = "nesam"
    """What it imagines in: NeSAM predicts as well as the whole Verti-WM, many times faster."""


@struct.dataclass
class Planner(Imagining):
    """Drives by the best of several imagined futures.

    Candidates are drawn about the policy's action; from each the model is rolled out with the
    policy deciding on, and what the critic expects where imagination ends is added to the rewards
    (Lowrey et al., 2019, "Plan online, learn offline").

    policy, value: as learned with this `interval` and base. discount: for each decision.
    """

    policy: MeanAction
    value: Value | TwinValue
    base: Controller | None = struct.field(pytree_node=False)
    interval: int = struct.field(pytree_node=False)
    discount: float = struct.field(pytree_node=False)
    config: PlanningConfig = struct.field(pytree_node=False, default=PlanningConfig())

    def plan(self, now: Now, memory: Plan, key: jax.Array) -> Plan:
        """The first action of the best imagined future."""
        noise_key, key = jax.random.split(key)
        usual = self.policy(now.observation)
        candidates = around(usual, self.config.candidates, self.config.spread, noise_key)
        returns = self.returns(now, memory, candidates, key)
        return replace(memory, corrections=candidates[jnp.argmax(returns)][None])

    def imagine(self, now: Now, candidate: jax.Array, key: jax.Array) -> jax.Array:
        """The discounted return `[]` of one action and of what the policy makes of it."""

        def advance(
            carry: tuple[Future, jax.Array], key: jax.Array
        ) -> tuple[tuple[Future, jax.Array], None]:
            future = self.hold(now.task, *carry, key)
            return (future, self.policy(future.observation)), None

        keys = jax.random.split(key, self.config.decisions)
        (future, _), _ = jax.lax.scan(advance, (Future.of(now), candidate), keys)
        return future.total + future.weight * self.value(future.observation)
