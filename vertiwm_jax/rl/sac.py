"""Soft actor-critic: the value of an action counts how random the policy stays after it.

Haarnoja et al. (2018), "Soft Actor-Critic Algorithms and Applications", with two critics and a
temperature that keeps the policy's entropy.
"""

from dataclasses import dataclass, replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct

from vertiwm_jax.config import Positive, settings
from vertiwm_jax.networks.policy import Senses, Squashed, SquashedActor
from vertiwm_jax.rl.collect import Metrics
from vertiwm_jax.rl.off_policy import Networks, OffPolicyConfig, Params, Remembered


@settings
class SACConfig(OffPolicyConfig):
    """Settings of SAC."""

    initial_log_std: float = -0.5
    """Log standard deviation of the first policy, in units of half the action range."""
    initial_temperature: Positive = 0.1
    """Worth of a nat of entropy in the first policy, in units of (normalised) reward."""
    target_entropy: float = -2.0
    """Entropy, nats, of the actions in [-1, 1] that the temperature is adjusted to keep."""


@struct.dataclass
class SACLearner:
    """What SAC has learned; averaged: the actor over its updates; target: of both critics, behind
    them; the rest are Adam's states."""

    actor: Params
    averaged: Params
    critics: Params
    target: Params
    log_temperature: jax.Array
    actor_optimiser: Any
    critic_optimiser: Any
    temperature_optimiser: Any


@dataclass(frozen=True)
class SAC:
    """The `off_policy.Rule` of soft actor-critic."""

    config: SACConfig

    def actor(self, actions: int, senses: Senses) -> SquashedActor:
        config = self.config
        return SquashedActor(actions, config.hidden, config.initial_log_std, senses)

    def init(self, networks: Networks, observation: jax.Array, key: jax.Array) -> SACLearner:
        actor, critics = networks.init(key, observation)
        log_temperature = jnp.log(jnp.float32(self.config.initial_temperature))
        return SACLearner(
            actor=actor,
            averaged=jax.tree.map(jnp.array, actor),
            critics=critics,
            target=jax.tree.map(jnp.array, critics),
            log_temperature=log_temperature,
            actor_optimiser=networks.optimiser.init(actor),
            critic_optimiser=networks.optimiser.init(critics),
            temperature_optimiser=networks.optimiser.init(log_temperature),
        )

    def explore(
        self, networks: Networks, learner: SACLearner, observation: jax.Array, key: jax.Array
    ) -> jax.Array:
        return _policy(networks, learner.actor, observation).sample(key)[0]

    def learn(
        self, networks: Networks, learner: SACLearner, batch: Remembered, key: jax.Array
    ) -> tuple[SACLearner, Metrics]:
        target_key, actor_key = jax.random.split(key)
        temperature = jnp.exp(learner.log_temperature)
        action, log_prob = _policy(networks, learner.actor, batch.following).sample(target_key)
        later = jnp.min(networks.twins(learner.target, batch.following, action), axis=0)
        later = jnp.where(batch.terminated, 0.0, later - temperature * log_prob)
        target = batch.reward + self.config.discount * later

        critics, critic_optimiser, loss = networks.fit_critics(
            learner.critics, learner.critic_optimiser, batch, target
        )

        def actor_loss(actor: Params) -> tuple[jax.Array, jax.Array]:
            policy = _policy(networks, actor, batch.observation)
            action, log_prob = policy.sample(actor_key)
            value = jnp.minimum(*networks.twins(critics, batch.observation, action))
            cost = networks.cost(policy.mean, value)
            return cost + jnp.mean(temperature * log_prob - value), -jnp.mean(log_prob)

        (policy_loss, entropy), gradient = jax.value_and_grad(actor_loss, has_aux=True)(
            learner.actor
        )
        actor, actor_optimiser = networks.descend(gradient, learner.actor_optimiser, learner.actor)
        log_temperature, temperature_optimiser = networks.descend(
            entropy - self.config.target_entropy,
            learner.temperature_optimiser,
            learner.log_temperature,
        )
        rate = self.config.target_rate
        learner = replace(
            learner,
            actor=actor,
            averaged=optax.incremental_update(actor, learner.averaged, rate),
            critics=critics,
            target=optax.incremental_update(critics, learner.target, rate),
            log_temperature=log_temperature,
            actor_optimiser=actor_optimiser,
            critic_optimiser=critic_optimiser,
            temperature_optimiser=temperature_optimiser,
        )
        metrics = {
            "value_loss": loss,
            "policy_loss": policy_loss,
            "entropy": entropy,
            "temperature": temperature,
        }
        return learner, metrics


def _policy(networks: Networks, actor: Params, observation: jax.Array) -> Squashed:
    return cast(Squashed, networks.actor.apply(actor, observation))
