"""Planning without a learned policy: model predictive path integral control."""

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.config import Positive, settings
from vertiwm_jax.planning.planner import OpenLoopConfig, OpenLoopPlanner


@settings
class MPPIConfig(OpenLoopConfig):
    """What `MPPI` imagines before it decides, and what it makes of it."""

    temperature: Positive = 30.0
    """Reward by which a plan must be worse to count e times less."""


@struct.dataclass
class MPPI(OpenLoopPlanner):
    """Drives by the mean of many imagined plans, weighed by what each of them returns.

    Plans are drawn about the one that was intended, moved on by a decision; each counts
    exp(return / temperature) times (Williams et al., 2017, "Information theoretic MPC for
    model-based reinforcement learning", without its cost of control). What it gives is intended
    then, and its first decision is driven.
    """

    config: MPPIConfig = struct.field(pytree_node=False, default=MPPIConfig())

    def chosen(self, plans: jax.Array, returns: jax.Array) -> jax.Array:
        """`[D, 2]` the mean of the plans."""
        weights = jax.nn.softmax(returns / self.config.temperature)
        return jnp.tensordot(weights, plans, axes=1)
