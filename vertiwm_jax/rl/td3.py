"""Twin delayed deep deterministic policy gradient: Fujimoto et al. (2018)."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from vertiwm_jax.config import Count, NotNegative, settings
from vertiwm_jax.rl.algorithm import Metrics
from vertiwm_jax.rl.off_policy import Learner, OffPolicy, OffPolicyConfig, Params, Remembered
from vertiwm_jax.training import NONE


@settings
class TD3Config(OffPolicyConfig):
    """Settings of TD3."""

    exploration_noise: NotNegative = 0.3
    """Standard deviation of the noise on actions while learning, in units of half their range."""
    target_noise: NotNegative = 0.2
    """Standard deviation of the noise on the actions that targets are made of."""
    target_noise_clip: NotNegative = 0.5
    """Where that noise is cut off."""
    policy_delay: Count = 2
    """Gradient steps of the critics for each of the actor and of the targets."""


@dataclass(frozen=True)
class TD3(OffPolicy):
    """TD3; its learner also keeps the number of gradient steps, `[]` int32."""

    config: TD3Config

    def init_extra(self) -> jax.Array:
        return jnp.int32(0)

    def explore(self, learner: Learner, observation: jax.Array, key: jax.Array) -> jax.Array:
        action = self.distribution(learner.actor, observation).mean
        noise = self.config.exploration_noise * jax.random.normal(key, action.shape)
        return jnp.clip(action + noise, -1.0, 1.0)

    def learn(self, learner: Learner, batch: Remembered, key: jax.Array) -> tuple[Learner, Metrics]:
        config = self.config
        action = self.distribution(learner.averaged, batch.following).mean
        noise = config.target_noise * jax.random.normal(key, action.shape)
        noise = jnp.clip(noise, -config.target_noise_clip, config.target_noise_clip)
        action = jnp.clip(action + noise, -1.0, 1.0)
        later = jnp.min(self.twins(learner.target, batch.following, action), axis=0)
        learner, value_loss = self.fit_critics(learner, batch, later)
        learner = replace(learner, extra=learner.extra + 1)

        def improve(learner: Learner) -> tuple[Learner, jax.Array]:
            def actor_loss(actor: Params) -> tuple[jax.Array, None]:
                action = self.distribution(actor, batch.observation).mean
                value = self.twins(learner.critics, batch.observation, action)[0]
                return self.penalty(action, value) - jnp.mean(value), None

            return self.fit_actor(learner, actor_loss)[:2]

        def keep(learner: Learner) -> tuple[Learner, jax.Array]:
            return learner, jnp.float32(NONE)

        due = learner.extra % config.policy_delay == 0
        learner, policy_loss = jax.lax.cond(due, improve, keep, learner)
        return learner, {"value_loss": value_loss, "policy_loss": policy_loss}
