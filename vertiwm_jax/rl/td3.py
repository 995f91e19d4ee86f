"""Twin delayed deep deterministic policy gradient: Fujimoto et al. (2018)."""

from dataclasses import dataclass, replace
from typing import ClassVar, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct

from vertiwm_jax.config import Count, NotNegative, settings
from vertiwm_jax.networks.policy import TanhNormal, TanhNormalActor
from vertiwm_jax.rl.collect import Metrics
from vertiwm_jax.rl.off_policy import Learner, OffPolicy, OffPolicyConfig, Params, Remembered


@settings
class TD3Config(OffPolicyConfig):
    """Settings of TD3."""

    GONE: ClassVar[dict[str, str]] = OffPolicyConfig.GONE | {
        "exploration": "is now exploration_noise",
        "smoothing": "is now target_noise",
        "largest_smoothing": "is now target_noise_clip",
    }

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

    def actor(self, data: Params) -> TanhNormalActor:
        return TanhNormalActor(self._actions(data), self.config.hidden, None, self.layout)

    def init_learner(self, data: Params, observation: jax.Array, key: jax.Array) -> TD3Learner:
        return TD3Learner(**self.init_weights(data, observation, key), update=jnp.int32(0))

    def explore(
        self, data: Params, learner: TD3Learner, observation: jax.Array, key: jax.Array
    ) -> jax.Array:
        action = self._action(data, learner.actor, observation)
        noise = self.config.exploration_noise * jax.random.normal(key, action.shape)
        return jnp.clip(action + noise, -1.0, 1.0)

    def learn(
        self, data: Params, learner: TD3Learner, batch: Remembered, key: jax.Array
    ) -> tuple[TD3Learner, Metrics]:
        config = self.config
        action = self._action(data, learner.averaged, batch.following)
        noise = config.target_noise * jax.random.normal(key, action.shape)
        noise = jnp.clip(noise, -config.target_noise_clip, config.target_noise_clip)
        action = jnp.clip(action + noise, -1.0, 1.0)
        later = jnp.min(self.twins(learner.target, batch.following, action), axis=0)
        learner, value_loss = self.fit_critics(learner, batch, later)
        learner = replace(learner, update=learner.update + 1)
        learner, policy_loss = jax.lax.cond(
            learner.update % config.policy_delay == 0,
            lambda learner: self._improve(data, learner, batch),
            lambda learner: (learner, jnp.float32(jnp.nan)),
            learner,
        )
        return learner, {"value_loss": value_loss, "policy_loss": policy_loss}

    def _improve(
        self, data: Params, learner: TD3Learner, batch: Remembered
    ) -> tuple[TD3Learner, jax.Array]:
        """A gradient step of the actor, and the targets a little nearer; also the actor's loss."""

        def actor_loss(actor: Params) -> jax.Array:
            action = self._action(data, actor, batch.observation)
            value = self.twins(learner.critics, batch.observation, action)[0]
            return self.penalty(action, value) - jnp.mean(value)

        loss, gradient = jax.value_and_grad(actor_loss)(learner.actor)
        actor, optimizer = self.descend(gradient, learner.actor_optimizer, learner.actor)
        tau = self.config.tau
        return replace(
            learner,
            actor=actor,
            averaged=optax.incremental_update(actor, learner.averaged, tau),
            target=optax.incremental_update(learner.critics, learner.target, tau),
            actor_optimizer=optimizer,
        ), loss

    def _action(self, data: Params, actor: Params, observation: jax.Array) -> jax.Array:
        return cast(TanhNormal, self.actor(data).apply(actor, observation)).mean
