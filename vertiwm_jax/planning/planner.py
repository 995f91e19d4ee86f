"""What planners share: plans of decisions, and the return of a plan in a model."""

from abc import abstractmethod
from dataclasses import replace
from operator import attrgetter

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.config import Count, Discount, NotNegative, Positive, settings
from vertiwm_jax.dynamics import History, Params, step
from vertiwm_jax.env.agent import Agent, Now, corrected
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.models.registry import Imagined
from vertiwm_jax.state import STEP_SECONDS


@settings
class PlannerConfig:
    """How many futures a planner compares before it decides, and how long they are."""

    candidates: Count = 64
    """Plans compared at every decision; the first is what was intended anyway."""
    decisions: Count = 6
    """Decisions imagined of each plan."""
    spread: NotNegative = 0.5
    """Standard deviation of the other plans about it, in units of half the action range."""


@struct.dataclass
class Plan:
    """The memory of a planner.

    history: of its model, along the way really driven.
    corrections: `[K, 2]` decisions; they correct the base, or are actions where there is none.
        The first is held until the next plan.
    """

    history: History
    corrections: jax.Array


def around(usual: jax.Array, number: int, spread: float, key: jax.Array) -> jax.Array:
    """`[number, ...]` candidates in [-1, 1] about the usual `[...]`, which is the first."""
    noise = jax.random.normal(key, (number, *usual.shape)).at[0].set(0.0)
    return jnp.clip(usual + spread * noise, -1.0, 1.0)


@struct.dataclass
class Planner(Agent):
    """Draws plans about an intended one, and imagines in a model what each of them returns.

    The model needs not be the one that really moves the vehicle. Every decision is held for
    `interval` steps. Static like it: `discount`, for each decision; `planned`, how many decisions
    a plan keeps; and `base`, a controller that acts at every step, and that decisions correct.

    env: the task inside the model, static; dynamics: the model's parameters.
    """

    discount = 1.0
    planned = 1
    base = None

    env: NavigationEnv = struct.field(pytree_node=False)
    dynamics: Params
    config: PlannerConfig = struct.field(pytree_node=False)

    @property
    def imagined(self) -> NavigationEnv:
        """The task as it is imagined: decisions are held, and correct the base."""
        return replace(self.env, action_repeat=self.interval, base=self.base)

    def intended(self, now: Now, memory: Plan) -> jax.Array:
        """`[K, 2]` the plan about which others are drawn.

        The last one moved on by a decision; after its end the last decision again.
        """
        return jnp.concatenate([memory.corrections[1:], memory.corrections[-1:]])

    def decision(self, plan: jax.Array, number: jax.Array, observation: jax.Array) -> jax.Array:
        """`[2]` what is decided after `number` decisions of a plan `[K, 2]`; as planned."""
        return plan[number]

    @abstractmethod
    def expected(self, end: Now) -> jax.Array:
        """The discounted return `[]` of going on where imagination ends."""

    def chosen(self, plans: jax.Array, returns: jax.Array) -> jax.Array:
        """`[K, 2]` the plan to follow, by the returns `[N]` of plans `[N, K, 2]`: the best."""
        return plans[jnp.argmax(returns)]

    def init(self, now: Now) -> Plan:
        """The model's first history, and no correction."""
        terrain = now.task.observed_map(now.state)
        history = self.env.dynamics.init(self.dynamics, terrain, now.state.vehicle)
        return Plan(history, jnp.zeros((self.planned, 2)))

    def plan(self, now: Now, memory: Plan, key: jax.Array) -> Plan:
        """What is chosen of plans drawn about the intended one."""
        noise_key, key = jax.random.split(key)
        candidates, spread = self.config.candidates, self.config.spread
        plans = around(self.intended(now, memory), candidates, spread, noise_key)
        returns = self.returns(now, memory, plans, key)
        return replace(memory, corrections=self.chosen(plans, returns))

    def act(self, now: Now, memory: Plan, key: jax.Array) -> tuple[jax.Array, Plan]:
        """The base, corrected as planned; the model's history follows the vehicle."""
        action = corrected(self.base, now.observation, key, memory.corrections[0])
        terrain = now.task.observed_map(now.state)
        command = now.task.vehicle.command(action, self.env.config.speed_range)
        given = self.dynamics, terrain, memory.history, now.state.vehicle, command
        _, history = step(self.env.dynamics, *given)
        return action, replace(memory, history=history)

    def returns(self, now: Now, memory: Plan, plans: jax.Array, key: jax.Array) -> jax.Array:
        """`[N]` what plans `[N, K, 2]` would return from where the vehicle is."""
        each = jax.vmap(self.imagine, (None, 0, None))
        return each(self.inside(now, memory), plans, key)

    def inside(self, now: Now, memory: Plan) -> Now:
        """The task as it is now, inside the model; the map as observed is the true one there."""
        terrain = now.task.observed_map(now.state)
        task = replace(now.task, dynamics=self.dynamics, terrain=terrain)
        state = replace(now.state, history=memory.history, observed=None)
        return replace(now, task=task, state=state)

    def imagine(self, now: Now, plan: jax.Array, key: jax.Array) -> jax.Array:
        """The discounted return `[]` of a plan `[K, 2]`; `now` is inside the model.

        Episodes end in imagination as they do in truth: a plan that fails forgoes all that would
        have come.
        """
        env = self.imagined

        def advance(carry: tuple, inputs: tuple[jax.Array, jax.Array]) -> tuple[tuple, None]:
            (observation, state, weight, total), (number, key) = carry, inputs
            decision = self.decision(plan, number, observation)
            observation, state, reward, ended, _ = env.step_env(key, state, decision, now.task)
            total = total + weight * reward
            ended = ended | env.is_truncated(state, now.task)
            weight = jnp.where(ended, 0.0, weight * self.discount)
            return (observation, state, weight, total), None

        decisions = self.config.decisions
        inputs = jnp.arange(decisions), jax.random.split(key, decisions)
        start = now.observation, now.state, jnp.float32(1), jnp.float32(0)
        (observation, state, weight, total), _ = jax.lax.scan(advance, start, inputs)
        return total + weight * self.expected(Now(now.task, state, observation))


@settings
class OpenLoopConfig(PlannerConfig):
    """What a planner without a policy imagines before it decides."""

    interval: Count = 8
    """Steps of 0.1 s that a decision is held."""
    discount: Discount = 0.98
    """Of rewards, for each decision."""
    pace: Positive = 3.0
    """Speed, m/s, at which costs to go are expected to fall where a plan ends."""
    model: Imagined = "nesam"
    """What it imagines in: NeSAM predicts as well as the whole Verti-WM, many times faster."""


@struct.dataclass
class OpenLoopPlanner(Planner):
    """Plans a whole sequence of decisions; the first is driven, and the rest is revised then."""

    config: OpenLoopConfig = struct.field(pytree_node=False)

    interval = property(attrgetter("config.interval"))
    discount = property(attrgetter("config.discount"))
    planned = property(attrgetter("config.decisions"))

    def expected(self, end: Now) -> jax.Array:
        """The discounted return `[]` of going on by the route to the goal, at a steady pace."""
        reward, discount = self.env.config.reward, self.config.discount
        left = jnp.maximum(end.task.cost_to_go(end.state) - self.env.config.goal_radius, 0.0)
        stride = self.config.pace * self.config.interval * STEP_SECONDS
        at_goal = discount ** (left / stride)
        on_the_way = reward.progress * stride * (1 - at_goal) / (1 - discount)
        return on_the_way + reward.goal * at_goal
