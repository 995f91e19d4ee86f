"""Decision-time planning: a learned policy, improved by imagining what its actions lead to."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.config import Count, NotNegative, settings
from vertiwm_jax.env.agent import Now, Policy
from vertiwm_jax.models.registry import ModelName
from vertiwm_jax.planning.planner import Plan, Planner, PlannerConfig


@settings
class ImprovementConfig(PlannerConfig):
    """How far a trained policy looks ahead before it decides."""

    candidates: Count = 8
    """Actions compared at every decision; the first is what the policy does anyway."""
    decisions: Count = 4
    """Decisions imagined of each: the candidate, then those of the policy."""
    spread: NotNegative = 0.4
    """Standard deviation of the other candidates about it, in units of half the action range."""
    model: ModelName = "nesam"
    """What it imagines in: NeSAM predicts as well as the whole Verti-WM, many times faster."""


@struct.dataclass
class PolicyImprovement(Planner):
    """Drives by the best of several imagined futures of a policy.

    Plans are a single action, drawn about the policy's; from each the model is rolled out with the
    policy deciding on, and what the critic expects where imagination ends is added to the rewards
    (Lowrey et al., 2019, "Plan online, learn offline").

    policy: observation `[O]` to action `[2]`; value: observation `[O]` to return `[]`; both as
        learned with this `interval` and base. discount: for each decision.
    """

    config: ImprovementConfig = struct.field(pytree_node=False)
    policy: Callable[[jax.Array], jax.Array]
    value: Callable[[jax.Array], jax.Array]
    base: Policy | None = struct.field(pytree_node=False)
    interval: int = struct.field(pytree_node=False)
    discount: float = struct.field(pytree_node=False)

    def intended(self, now: Now, memory: Plan) -> jax.Array:
        """`[1, 2]` what the policy does."""
        return self.policy(now.observation)[None]

    def decision(self, plan: jax.Array, number: jax.Array, observation: jax.Array) -> jax.Array:
        """`[2]` the planned action, then those of the policy."""
        return jnp.where(number == 0, plan[0], self.policy(observation))

    def expected(self, end: Now) -> jax.Array:
        """The discounted return `[]` that the critic expects."""
        return self.value(end.observation)
