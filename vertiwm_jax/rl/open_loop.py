"""What planners without a learned policy share: plans of decisions, and what a plan is worth."""

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.config import Count, Discount, NotNegative, Positive, settings
from vertiwm_jax.env.agent import Now
from vertiwm_jax.env.task import TaskParams, TaskState
from vertiwm_jax.models.registry import Imagined
from vertiwm_jax.rl.imagining import Future, Imagining, Plan
from vertiwm_jax.state import STEP_SECONDS


@settings
class OpenLoopConfig:
    """What a planner imagines before it decides."""

    candidates: Count = 64
    """Plans compared at every decision; the first is what was intended anyway."""
    decisions: Count = 6
    """Decisions in a plan."""
    interval: Count = 8
    """Steps of 0.1 s that a decision is held."""
    spread: NotNegative = 0.5
    """Standard deviation of the other plans about it, in units of half the action range."""
    discount: Discount = 0.98
    """Of rewards, for each decision."""
    pace: Positive = 3.0
    """Speed, m/s, at which costs to go are expected to fall where a plan ends."""
    model: Imagined = "nesam"
    """What it imagines in: NeSAM predicts as well as the whole Verti-WM, many times faster."""


@struct.dataclass
class OpenLoop(Imagining):
    """Intends a sequence of decisions, of which one after the other is driven and then revised.

    Plans are worth what the task returns, whose episodes end in imagination as they do in truth,
    so that a plan that fails forgoes all that would have come.
    """

    config: OpenLoopConfig = struct.field(pytree_node=False)

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

    def intended(self, memory: Plan) -> jax.Array:
        """`[D, 2]` the plan moved on by a decision; after the last one it is the same again."""
        return jnp.concatenate([memory.corrections[1:], memory.corrections[-1:]])

    def imagine(self, now: Now, candidate: jax.Array, key: jax.Array) -> jax.Array:
        """The discounted return `[]` of a plan `[D, 2]` and of what is expected after it."""

        def advance(future: Future, inputs: tuple[jax.Array, jax.Array]) -> tuple[Future, None]:
            return self.hold(now.task, future, *inputs), None

        keys = jax.random.split(key, self.config.decisions)
        future, _ = jax.lax.scan(advance, Future.of(now), (candidate, keys))
        return future.total + future.weight * self.expected(now.task, future.state)

    def expected(self, task: TaskParams, state: TaskState) -> jax.Array:
        """The discounted return `[]` of going on by the route to the goal, at a steady pace."""
        reward, discount = self.env.config.reward, self.config.discount
        left = jnp.maximum(task.cost_to_go(state) - self.env.config.goal_radius, 0.0)
        stride = self.config.pace * self.config.interval * STEP_SECONDS
        at_goal = discount ** (left / stride)
        on_the_way = reward.progress * stride * (1 - at_goal) / (1 - discount)
        return on_the_way + reward.goal * at_goal
