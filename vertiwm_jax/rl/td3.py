"""Twin delayed deep deterministic policy gradient: Fujimoto et al. (2018)."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.config import Count, NotNegative, settings
from vertiwm_jax.rl.collect import Metrics
from vertiwm_jax.rl.off_policy import Learner, OffPolicy, OffPolicyConfig, Params, Remembered


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


@struct.dataclass
class TD3Learner(Learner):
    """What TD3 has learned; `averaged` is its target actor; update: `[]` int32, gradient steps."""

    update: jax.Array


@dataclass(frozen=True)
class TD3(OffPolicy[TD3Learner]):
    """Twin delayed deep deterministic policy gradient."""

    config: TD3Config

    def init_learner(self, observation: jax.Array, key: jax.Array) -> TD3Learner:
        return TD3Learner(**self.init_weights(observation, key), update=jnp.int32(0))

    def explore(self, learner: TD3Learner, observation: jax.Array, key: jax.Array) -> jax.Array:
        action = self.distribution(learner.actor, observation).mean
        noise = self.config.exploration_noise * jax.random.normal(key, action.shape)
        return jnp.clip(action + noise, -1.0, 1.0)

    def learn(
        self, learner: TD3Learner, batch: Remembered, key: jax.Array
    ) -> tuple[TD3Learner, Metrics]:
        config = self.config
        action = self.distribution(learner.averaged, batch.following).mean
        noise = config.target_noise * jax.random.normal(key, action.shape)
        noise = jnp.clip(noise, -config.target_noise_clip, config.target_noise_clip)
        action = jnp.clip(action + noise, -1.0, 1.0)
        later = jnp.min(self.twins(learner.target, batch.following, action), axis=0)
        learner, value_loss = self.fit_critics(learner, batch, later)
        learner = replace(learner, update=learner.update + 1)

        def improve(learner: TD3Learner) -> tuple[TD3Learner, jax.Array]:
            def actor_loss(actor: Params) -> tuple[jax.Array, None]:
                action = self.distribution(actor, batch.observation).mean
                value = self.twins(learner.critics, batch.observation, action)[0]
                return self.penalty(action, value) - jnp.mean(value), None

            return self.fit_actor(learner, actor_loss)[:2]

        def keep(learner: TD3Learner) -> tuple[TD3Learner, jax.Array]:
            return learner, jnp.float32(jnp.nan)

        due = learner.update % config.policy_delay == 0
        learner, policy_loss = jax.lax.cond(due, improve, keep, learner)
        return learner, {"value_loss": value_loss, "policy_loss": policy_loss}
