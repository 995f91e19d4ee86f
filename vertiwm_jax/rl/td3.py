"""Twin delayed deep deterministic policy gradient: Fujimoto et al. (2018)."""

from dataclasses import dataclass, replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct

from vertiwm_jax.config import Count, NotNegative, settings
from vertiwm_jax.networks.policy import Senses, Squashed, SquashedActor
from vertiwm_jax.rl.collect import Metrics
from vertiwm_jax.rl.off_policy import Networks, OffPolicyConfig, Params, Remembered


@settings
class TD3Config(OffPolicyConfig):
    """Settings of TD3."""

    exploration: NotNegative = 0.3
    """Standard deviation of the noise on actions while learning, in units of half their range."""
    smoothing: NotNegative = 0.2
    """Standard deviation of the noise on the actions that targets are made of."""
    largest_smoothing: NotNegative = 0.5
    """Where that noise is cut off."""
    policy_delay: Count = 2
    """Gradient steps of the critics for each of the actor and of the targets."""


@struct.dataclass
class TD3Learner:
    """What TD3 has learned; targets follow behind; update: `[]` int32, gradient steps done."""

    actor: Params
    critics: Params
    actor_target: Params
    critic_target: Params
    actor_optimiser: Any
    critic_optimiser: Any
    update: jax.Array

    @property
    def averaged(self) -> Params:
        """The actor over its updates, which its target is."""
        return self.actor_target


@dataclass(frozen=True)
class TD3:
    """The `off_policy.Rule` of TD3."""

    config: TD3Config

    def actor(self, actions: int, senses: Senses) -> SquashedActor:
        return SquashedActor(actions, self.config.hidden, None, senses)

    def init(self, networks: Networks, observation: jax.Array, key: jax.Array) -> TD3Learner:
        actor, critics = networks.init(key, observation)
        return TD3Learner(
            actor=actor,
            critics=critics,
            actor_target=jax.tree.map(jnp.array, actor),
            critic_target=jax.tree.map(jnp.array, critics),
            actor_optimiser=networks.optimiser.init(actor),
            critic_optimiser=networks.optimiser.init(critics),
            update=jnp.int32(0),
        )

    def explore(
        self, networks: Networks, learner: TD3Learner, observation: jax.Array, key: jax.Array
    ) -> jax.Array:
        action = _action(networks, learner.actor, observation)
        noise = self.config.exploration * jax.random.normal(key, action.shape)
        return jnp.clip(action + noise, -1.0, 1.0)

    def learn(
        self, networks: Networks, learner: TD3Learner, batch: Remembered, key: jax.Array
    ) -> tuple[TD3Learner, Metrics]:
        config = self.config
        action = _action(networks, learner.actor_target, batch.following)
        noise = config.smoothing * jax.random.normal(key, action.shape)
        noise = jnp.clip(noise, -config.largest_smoothing, config.largest_smoothing)
        action = jnp.clip(action + noise, -1.0, 1.0)
        later = jnp.min(networks.twins(learner.critic_target, batch.following, action), axis=0)
        target = batch.reward + config.discount * jnp.where(batch.terminated, 0.0, later)

        critics, critic_optimiser, loss = networks.fit_critics(
            learner.critics, learner.critic_optimiser, batch, target
        )
        learner = replace(
            learner,
            critics=critics,
            critic_optimiser=critic_optimiser,
            update=learner.update + 1,
        )
        improving = learner.update % config.policy_delay == 0
        learner, policy_loss = jax.lax.cond(
            improving,
            lambda learner: self._improve(networks, learner, batch),
            lambda learner: (learner, jnp.float32(jnp.nan)),
            learner,
        )
        return learner, {"value_loss": loss, "policy_loss": policy_loss}

    def _improve(
        self, networks: Networks, learner: TD3Learner, batch: Remembered
    ) -> tuple[TD3Learner, jax.Array]:
        """A gradient step of the actor, and the targets a little nearer; also the actor's loss."""

        def actor_loss(actor: Params) -> jax.Array:
            action = _action(networks, actor, batch.observation)
            value = networks.twins(learner.critics, batch.observation, action)[0]
            return networks.cost(action, value) - jnp.mean(value)

        loss, gradient = jax.value_and_grad(actor_loss)(learner.actor)
        actor, optimiser = networks.descend(gradient, learner.actor_optimiser, learner.actor)

        rate = self.config.target_rate
        return replace(
            learner,
            actor=actor,
            actor_target=optax.incremental_update(actor, learner.actor_target, rate),
            critic_target=optax.incremental_update(learner.critics, learner.critic_target, rate),
            actor_optimiser=optimiser,
        ), loss


def _action(networks: Networks, actor: Params, observation: jax.Array) -> jax.Array:
    return cast(Squashed, networks.actor.apply(actor, observation)).mean
