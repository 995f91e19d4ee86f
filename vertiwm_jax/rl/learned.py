"""A learned policy apart from the algorithm that made it."""

from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.networks.policy import Actor, Gaussian
from vertiwm_jax.rl.normalise import RunningStatistics

Controller = Callable[[jax.Array, Any], jax.Array]
"""`(observation [..., O], key)` to actions `[..., A]` in [-1, 1]."""


@struct.dataclass
class MeanAction:
    """The learned policy as it is used: always the mean of its Gaussian.

    actor: the network, static; params: its weights.
    observations: statistics that its observations are normalised by.
    base: the controller that it corrects, static, if there is one.
    """

    actor: Actor = struct.field(pytree_node=False)
    params: Any
    observations: RunningStatistics
    base: Controller | None = struct.field(pytree_node=False, default=None)

    def __call__(self, observation: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """`[..., O]` observations to `[..., A]` actions in [-1, 1]; the key is not used."""
        seen = self.observations.normalise(observation)
        policy = cast(Gaussian, self.actor.apply(self.params, seen))
        base = self.base(observation, key) if self.base else 0.0
        return jnp.clip(base + policy.mean, -1.0, 1.0)
