"""Soft actor-critic: the value of an action counts how random the policy stays after it.

Haarnoja et al. (2018), "Soft Actor-Critic Algorithms and Applications", with two critics and a
temperature that keeps the policy's entropy.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp

from vertiwm_jax.config import Positive, settings
from vertiwm_jax.rl.algorithm import Metrics
from vertiwm_jax.rl.off_policy import Learner, OffPolicy, OffPolicyConfig, Params, Remembered


@settings
class SACConfig(OffPolicyConfig):
    """Settings of SAC."""

    initial_log_std: float = -0.9
    """Log standard deviation of the first policy, in units of half the action range."""
    initial_temperature: Positive = 0.1
    """Worth of a nat of entropy in the first policy, in units of (normalized) reward."""
    target_entropy: float = -2.0
    """Entropy, nats, of the actions in [-1, 1] that the temperature is adjusted to keep."""


@dataclass(frozen=True)
class SAC(OffPolicy):
    """Soft actor-critic; its learner also keeps the log temperature and the state of its Adam."""

    config: SACConfig

    def init_extra(self) -> tuple[jax.Array, Any]:
        log_temperature = jnp.log(jnp.float32(self.config.initial_temperature))
        return log_temperature, self.optimizer.init(log_temperature)

    def explore(self, learner: Learner, observation: jax.Array, key: jax.Array) -> jax.Array:
        return self.distribution(learner.actor, observation).sample(key)[0]

    def learn(self, learner: Learner, batch: Remembered, key: jax.Array) -> tuple[Learner, Metrics]:
        target_key, actor_key = jax.random.split(key)
        log_temperature, optimizer = learner.extra
        temperature = jnp.exp(log_temperature)
        action, log_prob = self.distribution(learner.actor, batch.following).sample(target_key)
        later = jnp.min(self.twins(learner.target, batch.following, action), axis=0)
        learner, value_loss = self.fit_critics(learner, batch, later - temperature * log_prob)

        def actor_loss(actor: Params) -> tuple[jax.Array, jax.Array]:
            policy = self.distribution(actor, batch.observation)
            action, log_prob = policy.sample(actor_key)
            value = jnp.minimum(*self.twins(learner.critics, batch.observation, action))
            cost = self.penalty(policy.mean, value)
            return cost + jnp.mean(temperature * log_prob - value), -jnp.mean(log_prob)

        learner, policy_loss, entropy = self.fit_actor(learner, actor_loss)
        excess = entropy - self.config.target_entropy
        learner = replace(learner, extra=self.descend(excess, optimizer, log_temperature))
        metrics = {
            "value_loss": value_loss,
            "policy_loss": policy_loss,
            "entropy": entropy,
            "temperature": temperature,
        }
        return learner, metrics
