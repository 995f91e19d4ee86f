"""Planning without a learned policy: gradient ascent on plans, through the model."""

from dataclasses import replace
from typing import cast

import jax
import jax.numpy as jnp
import optax
from flax import struct

from vertiwm_jax.config import Count, CountOrZero, Positive, settings
from vertiwm_jax.env.agent import Now
from vertiwm_jax.env.observation import distance_and_bearing
from vertiwm_jax.env.reward import ending_reward
from vertiwm_jax.env.task import TaskParams, TaskState
from vertiwm_jax.env.termination import TerminationReason, edge_distance
from vertiwm_jax.models.registry import Imagined
from vertiwm_jax.planning.planner import OpenLoopConfig, OpenLoopPlanner, Plan, around
from vertiwm_jax.terrain import obstacles


@settings
class ShootingConfig(OpenLoopConfig):
    """What `Shooting` imagines before it decides, and how it improves the best of it."""

    candidates: Count = 32
    improved: Count = 4
    """How many of them, the best, are improved."""
    steps: CountOrZero = 4
    """Gradient steps by which each is improved."""
    rate: Positive = 0.1
    """Size of these steps, by Adam, in units of half the action range."""
    clearance: Positive = 0.3
    """Metres in which nearing an obstacle, the edge or the goal goes over into having met it."""
    leeway: Positive = 0.1
    """Radians in which tilting goes over into rolling over."""
    model: Imagined = "bicycle"
    """What it imagines in; NeSAM's gradient takes minutes to compile, the bicycle's seconds."""

    def check(self):
        found, most = self.improved, self.candidates
        if found > most:
            raise ValueError(f"improved: expected 1 to the {most} candidates, found {found}")


@struct.dataclass
class Shooting(OpenLoopPlanner):
    """Drives by the best imagined plan, after its gradient has improved it.

    Plans are drawn about the one that was intended, moved on by a decision. Those that return most
    take steps up the gradient of what they return, through all steps of the model (single
    shooting). The return is a smooth one: of two plans that miss a rock, the one that keeps farther
    from it returns more.

    env: of a model whose gradients are exact, see `exact_gradient` of `load_model`.
    """

    config: ShootingConfig = struct.field(pytree_node=False, default=ShootingConfig())

    def plan(self, now: Now, memory: Plan, key: jax.Array) -> Plan:
        """The best plan."""
        config = self.config
        drawn = around(self.intended(now, memory), config.candidates, config.spread, key)
        inside, worth = self.inside(now, memory), jax.vmap(self.smooth_return, (None, 0))
        best = drawn[jax.lax.top_k(worth(inside, drawn), config.improved)[1]]
        plans = jnp.concatenate([best, self.improve(inside, best)])
        return replace(memory, corrections=self.chosen(plans, worth(inside, plans)))

    def improve(self, now: Now, plans: jax.Array) -> jax.Array:
        """`[N, D, 2]` plans, each after `steps` of Adam up the gradient of its `smooth_return`.

        Plans stay within [-1, 1], and as they are where a gradient is not finite. `now` is inside
        the model.
        """
        optimizer = optax.adam(self.config.rate)
        slope = jax.vmap(jax.grad(self.smooth_return, argnums=1), (None, 0))

        def ascend(carry: tuple[jax.Array, optax.OptState], _: None) -> tuple[tuple, None]:
            plans, memory = carry
            gradient = slope(now, plans)
            usable = jnp.all(jnp.isfinite(gradient), axis=(1, 2), keepdims=True)
            updates, memory = optimizer.update(jnp.where(usable, -gradient, 0.0), memory)
            return (jnp.clip(plans + cast(jax.Array, updates), -1.0, 1.0), memory), None

        carry = plans, optimizer.init(plans)
        return jax.lax.scan(ascend, carry, length=self.config.steps)[0][0]

    def smooth_return(self, now: Now, plan: jax.Array) -> jax.Array:
        """`[]` like the return of a plan `[D, 2]`, but endings come by degrees.

        Where the task ends, at a distance or at an angle, an episode goes on here with a weight
        that a sigmoid lets sink, and the ending's reward counts by what was lost: whoever nears a
        rock feels it before the two touch. Standing still has no gradient.
        """
        env, reward, task = self.env, self.env.config.reward, now.task
        discount = self.config.discount ** (1 / self.config.interval)

        def advance(carry: tuple, action: jax.Array) -> tuple[tuple, None]:
            before, weight, total = carry
            # Nothing in a step is random; what it observes is not computed.
            _, after, gain, _, _ = env.step_env(jax.random.key(0), before, action, task)
            distance, _ = distance_and_bearing(after.vehicle.position, after.goal)
            ended = ending_reward(reward, after.ending, distance)
            gain = gain - jnp.where(before.ending == TerminationReason.RUNNING, ended, 0.0)
            remains = jnp.float32(1)
            for ending, share in self._nearness(task, after, distance).items():
                gain = gain + share * ending_reward(reward, jnp.int32(ending), distance)
                remains = remains * (1 - share)
            return (after, weight * discount * remains, total + weight * gain), None

        actions = jnp.repeat(plan, self.config.interval, axis=0)
        start = now.state, jnp.float32(1), jnp.float32(0)
        (end, weight, total), _ = jax.lax.scan(advance, start, actions)
        return total + weight * self.expected(replace(now, state=end))

    def _nearness(
        self, task: TaskParams, state: TaskState, distance: jax.Array
    ) -> dict[TerminationReason, jax.Array]:
        """`[]` from 0 to 1 for endings at a distance or an angle, 1/2 where the task draws them."""
        config, position = self.env.config, state.vehicle.position[:2]
        terrain, vehicle = task.terrain.select(state.world), task.vehicle
        roll, pitch, yaw = state.vehicle.rpy
        tilt = jnp.maximum(jnp.abs(roll), jnp.abs(pitch))
        gap = obstacles.gap(terrain, position, yaw, vehicle.length, vehicle.width)
        beyond = {
            TerminationReason.GOAL: (config.goal_radius - distance) / self.config.clearance,
            TerminationReason.COLLIDED: -gap / self.config.clearance,
            TerminationReason.OFF_MAP: (config.map_margin - edge_distance(terrain, position))
            / self.config.clearance,
            TerminationReason.ROLLED_OVER: (tilt - config.rollover_angle) / self.config.leeway,
        }
        return {ending: jax.nn.sigmoid(x) for ending, x in beyond.items()}
