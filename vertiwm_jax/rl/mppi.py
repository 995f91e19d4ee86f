"""Planning without a learned policy: model predictive path integral control."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.config import Positive, settings
from vertiwm_jax.env.agent import Now
from vertiwm_jax.rl.imagining import Plan, around
from vertiwm_jax.rl.open_loop import OpenLoop, OpenLoopConfig


@settings
class MPPIConfig(OpenLoopConfig):
    """What `MPPI` imagines before it decides, and what it makes of it."""

    temperature: Positive = 30.0
    """Reward by which a plan must be worse to count e times less."""


@struct.dataclass
class MPPI(OpenLoop):
    """Drives by the mean of many imagined plans, weighed by what each of them returns.

    Plans are drawn about the one that was intended, moved on by a decision; each counts
    exp(return / temperature) times (Williams et al., 2017, "Information theoretic MPC for
    model-based reinforcement learning", without its cost of control). What it gives is intended
    then, and its first decision is driven.
    """

    config: MPPIConfig = struct.field(pytree_node=False, default=MPPIConfig())

    def plan(self, now: Now, memory: Plan, key: jax.Array) -> Plan:
        """The plans' mean."""
        noise_key, key = jax.random.split(key)
        config = self.config
        candidates = around(self.intended(memory), config.candidates, config.spread, noise_key)
        returns = self.returns(now, memory, candidates, key)
        weights = jax.nn.softmax(returns / config.temperature)
        return replace(memory, corrections=jnp.tensordot(weights, candidates, axes=1))
