"""A learned policy apart from the algorithm that made it."""

from typing import Any, cast

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.env.agent import Policy, corrected
from vertiwm_jax.networks.policy import (
    ActionCritic,
    Actor,
    Critic,
    Gaussian,
    TanhNormal,
    TanhNormalActor,
    twin_values,
)
from vertiwm_jax.rl.running_statistics import RunningStatistics


@struct.dataclass
class DeterministicPolicy:
    """The learned policy as it is used: always the mean of what it would draw.

    actor: the network, static; params: its weights.
    observations: statistics that its observations are normalized by.
    """

    actor: Actor | TanhNormalActor = struct.field(pytree_node=False)
    params: Any
    observations: RunningStatistics

    def __call__(self, observation: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """`[..., O]` observations to `[..., A]` actions in [-1, 1]; the key is not used."""
        seen = self.observations.normalize(observation)
        policy = cast(Gaussian | TanhNormal, self.actor.apply(self.params, seen))
        return jnp.clip(policy.mean, -1.0, 1.0)


@struct.dataclass
class Value:
    """The return that a learned policy can expect, as far as it was learned.

    critic: the network, static; params: its weights. A critic of actions has two sets of them, with
        an axis for both, and the lower value counts.
    policy: whose return it is; scale: `[]` of the critic's output.
    """

    critic: Critic | ActionCritic = struct.field(pytree_node=False)
    params: Any
    policy: DeterministicPolicy
    scale: jax.Array

    def __call__(self, observation: jax.Array) -> jax.Array:
        """`[..., O]` observations to `[...]` values, in units of reward."""
        seen = self.policy.observations.normalize(observation)
        if isinstance(self.critic, Critic):
            return self.scale * cast(jax.Array, self.critic.apply(self.params, seen))
        values = twin_values(self.critic, self.params, seen, self.policy(observation))
        return self.scale * jnp.min(values, axis=0)


@struct.dataclass
class ResidualPolicy:
    """A controller, static, with what was learned to correct it."""

    base: Policy = struct.field(pytree_node=False)
    correction: DeterministicPolicy

    def __call__(self, observation: jax.Array, key: jax.Array) -> jax.Array:
        """`[..., O]` observations to `[..., A]` actions in [-1, 1]."""
        return corrected(self.base, observation, key, self.correction(observation))
