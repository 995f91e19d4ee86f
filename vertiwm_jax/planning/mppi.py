"""Planning without a learned policy: model predictive path integral control."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.config import NotNegative, Positive, settings
from vertiwm_jax.env.agent import Now
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.route import CLEARANCE
from vertiwm_jax.planning.planner import OpenLoopConfig, OpenLoopPlanner, Plan
from vertiwm_jax.terrain import obstacles


@settings
class MPPIConfig(OpenLoopConfig):
    """What `MPPI` imagines before it decides, and what it makes of it."""

    spread: NotNegative = 1.0
    """Wide enough that plans to back up are among those drawn while it drives ahead."""
    temperature: Positive = 30.0
    """Reward by which a plan must be worse to count e times less."""
    tilt: NotNegative = 200.0
    """What roll and pitch beyond `tilt_limit` cost in imagination, in place of the task's weight.
    It is much, because the model may be wrong about a plan that barely stays upright."""
    tilt_limit: Positive = 0.3
    """Roll and pitch that cost nothing, rad."""
    clearance: NotNegative = CLEARANCE
    """How far, in m, plans keep from obstacles, unless the vehicle is nearer already."""


@struct.dataclass
class MPPI(OpenLoopPlanner):
    """Drives by the mean of many imagined plans, weighed by what each of them returns.

    Plans are drawn about the one that was intended, moved on by a decision; each counts
    exp(return / temperature) times (Williams et al., 2017, "Information theoretic MPC for
    model-based reinforcement learning", without its cost of control). What it gives is intended
    then, and its first decision is driven.
    """

    config: MPPIConfig = struct.field(pytree_node=False, default=MPPIConfig())

    @property
    def imagined(self) -> NavigationEnv:
        """The task as it is imagined, where tilting costs what the planner says."""
        task = self.env.config
        costs = {"tilt": self.config.tilt, "tilt_limit": self.config.tilt_limit}
        cautious = replace(task, reward=replace(task.reward, **costs))
        return replace(super().imagined, config=cautious)

    def inside(self, now: Now, memory: Plan) -> Now:
        """The task as it is now, inside the model, for a vehicle made larger by the clearance."""
        now = super().inside(now, memory)
        task, driven = now.task, now.state.vehicle
        vehicle, more = task.vehicle, 2 * self.config.clearance
        size = jnp.stack([vehicle.length, vehicle.width])
        pose = driven.position[:2], driven.rpy[2]
        # Too near already, every plan would end at once, and none be better than another.
        near = obstacles.collides(task.terrain, *pose, *(size + more))
        length, width = jnp.where(near, size, size + more)
        larger = replace(vehicle, length=length, width=width)
        return replace(now, task=replace(task, vehicle=larger))

    def chosen(self, plans: jax.Array, returns: jax.Array) -> jax.Array:
        """`[D, 2]` the mean of the plans."""
        weights = jax.nn.softmax(returns / self.config.temperature)
        return jnp.tensordot(weights, plans, axes=1)
