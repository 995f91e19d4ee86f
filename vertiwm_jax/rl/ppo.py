"""Proximal policy optimization, collection and update in one compiled program.

Schulman et al. (2017), with the details of Andrychowicz et al. (2021). It is written for one
device. Where a mesh is in context, each device does this with its share of the environments, and
they exchange gradients and statistics (`parallel.mean`).
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Literal, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.sharding import PartitionSpec

from vertiwm_jax import parallel
from vertiwm_jax.config import Count, NotNegative, Positive, Share, settings
from vertiwm_jax.networks.policy import Actor, Critic, Gaussian
from vertiwm_jax.parallel import BATCH, ROWS, WHOLE
from vertiwm_jax.precision import float32
from vertiwm_jax.rl.algorithm import LearningConfig, LearningState, Metrics, PolicyAlgorithm, Steps
from vertiwm_jax.training import all_finite, mean_in_turns

Params = Any
_BY_ENVIRONMENT = PartitionSpec(None, BATCH)
"""Of arrays `[T, N, ...]`, of which each device has some of N."""


@settings
class PPOConfig(LearningConfig):
    """Settings of PPO."""

    initial_log_std: float = -0.9
    """Log standard deviation of the first policy, in units of half the action range."""
    epochs: Count = 6
    """Passes over the data of an iteration."""
    minibatches: Count = 4
    """Gradient steps in a pass, each from as many steps of every environment; divides num_steps."""
    grad_accumulation: Count = 1
    """Parts of a minibatch whose gradients are computed one after the other, for less memory."""
    gae_lambda: Share = 0.95
    """Lambda of the generalized advantage estimator."""
    clip_eps: Positive = 0.2
    """Largest change of the probability ratio that is rewarded."""
    schedule: Literal["constant", "linear", "cosine"] = "linear"
    """How the learning rate goes, to 0 at the end unless constant."""
    vf_coef: NotNegative = 0.5
    """Weight of the value loss."""
    ent_coef: NotNegative = 0.0
    """Weight of the entropy bonus."""

    def check(self):
        parts = self.minibatches * self.grad_accumulation
        if self.num_steps % parts:
            divisor = math.gcd(parts, self.num_steps)
            raise ValueError(
                f"minibatches: expected minibatches * grad_accumulation, {parts}, to divide "
                f"num_steps, {self.num_steps}; choose a divisor, for example {divisor}"
            )


@struct.dataclass
class TrainState(LearningState):
    """All that training carries from one iteration to the next.

    params: the networks' weights, `{"actor": ..., "critic": ...}`; optimizer: the state of Adam.
    """

    params: Params
    optimizer: optax.OptState


Draws = tuple[jax.Array, jax.Array, jax.Array]
"""All that is random in an iteration, drawn for all N environments on any number of devices.

Noise `[T, N, A]` of actions, keys `[T, N]` of environments, and the order `[E, N, T]` in which
steps of each environment are learned from, in each epoch.
"""


@struct.dataclass
class Batch:
    """What the loss is made of, `[T, N]` as collected, or `[B]` of them.

    log_prob: of the actions, which are not clipped, when they were drawn; target: lambda returns.
    observation, advantage: normalized once they are learned from.
    """

    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    target: jax.Array


@dataclass(frozen=True)
class PPO(PolicyAlgorithm[TrainState]):
    """PPO, see `PolicyAlgorithm`."""

    specs: ClassVar[Any] = TrainState(WHOLE, WHOLE, WHOLE, WHOLE, ROWS, WHOLE, WHOLE)  # pyright: ignore

    config: PPOConfig

    @property
    def learning_rate_schedule(self) -> optax.Schedule:
        """Learning rate as a function of the gradient steps done."""
        rate = self.config.learning_rate
        steps = self.iterations * self.config.epochs * self.config.minibatches
        return {
            "constant": optax.constant_schedule(rate),
            "linear": optax.linear_schedule(rate, 0.0, steps),
            "cosine": optax.cosine_decay_schedule(rate, steps),
        }[self.config.schedule]

    @property
    def actor(self) -> Actor:
        config = self.config
        return Actor(self.actions, config.hidden, config.initial_log_std, self.layout)

    @property
    def critic(self) -> Critic:
        return Critic(self.config.hidden, self.layout)

    def weights(self, state: TrainState) -> tuple[Params, Params]:
        return state.params["actor"], state.params["critic"]

    @float32
    def init(self, data: Params, key: jax.Array) -> TrainState:
        """The state before the first iteration."""
        key, reset_key, actor_key, critic_key = jax.random.split(key, 4)
        begun = self.start(data, reset_key, key)
        observation = begun["environments"].observation[0]
        params = {
            "actor": self.actor.init(actor_key, observation),
            "critic": self.critic.init(critic_key, observation),
        }
        return TrainState(**begun, params=params, optimizer=self._optimizer.init(params))

    @float32
    def iterate(self, data: Params, state: TrainState) -> tuple[TrainState, Metrics]:
        """Collects `[T, N]` steps and learns from them; jit it with `state` donated.

        The metrics are scalars. Those of episodes are means over the episodes that ended in
        this iteration, `NONE` if there were none; `finite` says whether all weights still are.
        """
        key, collect_key, update_key = jax.random.split(state.key, 3)
        draws = self._draws(collect_key, update_key)
        on_device = parallel.shard(
            self._iterate, (WHOLE, self.specs, _BY_ENVIRONMENT), (self.specs, WHOLE)
        )
        return on_device(data, replace(state, key=key), draws)

    @property
    def _optimizer(self) -> optax.GradientTransformation:
        return self.config.adam(self.learning_rate_schedule, eps=1e-5)

    def _value(self, params: Params, observation: jax.Array) -> jax.Array:
        return cast(jax.Array, self.critic.apply(params["critic"], observation))

    def _draws(self, collect_key: jax.Array, update_key: jax.Array) -> Draws:
        config, environments = self.config, self.config.num_envs
        step_keys = jax.vmap(jax.random.split)(jax.random.split(collect_key, config.num_steps))
        noise = partial(jax.random.normal, shape=(environments, self.actions))
        order_keys = jax.random.split(update_key, config.epochs * environments)
        order = jax.vmap(partial(jax.random.permutation, x=config.num_steps))(order_keys)
        return (
            jax.vmap(noise)(step_keys[:, 0]),
            jax.vmap(lambda key: jax.random.split(key, environments))(step_keys[:, 1]),
            order.reshape(config.epochs, environments, -1),
        )

    def _iterate(self, data: Params, state: TrainState, draws: Draws) -> tuple[TrainState, Metrics]:
        """An iteration of one device with N environments of its own."""
        config, (noise, keys, order) = self.config, draws
        with jax.named_scope("collect"):
            running, steps, log_prob, value, next_value = self._collect(data, state, noise, keys)
        with jax.named_scope("advantages"):
            # Observations from the next iteration on: within one, all are normalized alike.
            following = self.with_statistics(state, steps)
            rewards = steps.reward / following.returns.std
            given = rewards, value, next_value, steps.terminated, steps.truncated
            advantage = gae(*given, config.discount, config.gae_lambda)
            target = advantage + value
            batch = Batch(steps.observation, steps.action, log_prob, advantage, target)
        with jax.named_scope("update"):
            params, optimizer, losses = self._update(state, batch, order)
        (_, unexplained), (_, variance) = map(parallel.moments, (target - value, target))
        metrics = {
            **losses,
            **steps.episode_metrics(),
            "reward": parallel.mean(jnp.mean(steps.reward)),
            "explained_variance": 1 - unexplained / variance,
            "finite": all_finite((params, losses)),
        }
        learned = {"params": params, "optimizer": optimizer, "environments": running}
        return replace(following, iteration=state.iteration + 1, **learned), metrics

    def _collect(
        self, data: Params, state: TrainState, noise: jax.Array, keys: jax.Array
    ) -> tuple[Any, Steps, jax.Array, jax.Array, jax.Array]:
        """T steps of N environments with the policy as it is.

        Also log probabilities of actions, and values `[T, N]` before and after the steps.
        """

        def value_of(observation: jax.Array) -> jax.Array:
            return self._value(state.params, state.observations.normalize(observation))

        def advance(
            running: Any, draw: tuple[jax.Array, jax.Array]
        ) -> tuple[Any, tuple[Steps, jax.Array, jax.Array, jax.Array]]:
            noise, keys = draw
            seen = state.observations.normalize(running.observation)
            policy = cast(Gaussian, self.actor.apply(state.params["actor"], seen))
            action = policy.mean + jnp.exp(policy.log_std) * noise
            running, steps, final = self.step(data, running, action, keys)
            # What follows is valued one step later, unless an episode was cut off.
            next_value = jax.lax.cond(
                jnp.any(steps.truncated), value_of, lambda x: jnp.zeros(len(x)), final
            )
            value = self._value(state.params, seen)
            return running, (steps, policy.log_prob(action), value, next_value)

        running, collected = jax.lax.scan(advance, state.environments, (noise, keys))
        steps, log_prob, value, next_value = collected
        following = jnp.concatenate([value[1:], value_of(running.observation)[None]])
        return running, steps, log_prob, value, jnp.where(steps.done, next_value, following)

    def _update(
        self, state: TrainState, batch: Batch, order: jax.Array
    ) -> tuple[Params, optax.OptState, Metrics]:
        """`epochs` passes of `minibatches` gradient steps; the losses are means over all.

        A minibatch has T / `minibatches` steps of every environment.
        """
        config, optimizer = self.config, self._optimizer
        epochs, environments, _ = order.shape
        rows = order.reshape(epochs, environments, config.minibatches, config.grad_accumulation, -1)
        rows = jnp.moveaxis(rows, 1, 3)
        rows = rows.reshape(-1, config.grad_accumulation, environments, rows.shape[-1])
        # Of all minibatches at once, lest devices wait for each other twice more in each.
        advantage = jax.vmap(jax.vmap(partial(take, batch.advantage)))(rows)
        mean, variance = parallel.moments(advantage, axis=(1, 2))

        def descend(carry: tuple[Params, optax.OptState], minibatch: tuple[jax.Array, ...]):
            (params, optimizer_state), (rows, mean, deviation) = carry, minibatch

            def of_part(rows: jax.Array) -> tuple[Params, Metrics]:
                part = jax.tree.map(lambda leaf: take(leaf, rows), batch)
                # Not before, and each part by itself, so that observations are normalized while
                # they are copied: copies of them take long to write.
                seen = [
                    state.observations.of(part).normalize(take(batch.observation, rows, part))
                    for part in self.layout.parts
                ]
                advantage = (part.advantage - mean) / (deviation + 1e-8)
                part = replace(part, observation=jnp.concatenate(seen, -1), advantage=advantage)
                return jax.grad(self._loss, has_aux=True)(params, part)

            gradients, losses = parallel.mean(mean_in_turns(of_part, rows))
            updates, optimizer_state = optimizer.update(gradients, optimizer_state, params)
            return (optax.apply_updates(params, updates), optimizer_state), losses

        (params, optimizer_state), losses = jax.lax.scan(
            descend, (state.params, state.optimizer), (rows, mean, jnp.sqrt(variance))
        )
        return params, optimizer_state, jax.tree.map(jnp.mean, losses)

    def _loss(self, params: Params, batch: Batch) -> tuple[jax.Array, Metrics]:
        config = self.config
        policy = cast(Gaussian, self.actor.apply(params["actor"], batch.observation))
        log_ratio = policy.log_prob(batch.action) - batch.log_prob
        ratio = jnp.exp(log_ratio)
        clipped = jnp.clip(ratio, 1 - config.clip_eps, 1 + config.clip_eps)
        policy_loss = -jnp.mean(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))

        value = self._value(params, batch.observation)
        value_loss = 0.5 * jnp.mean((value - batch.target) ** 2)

        entropy = policy.entropy()
        total = policy_loss + config.vf_coef * value_loss - config.ent_coef * entropy
        return total, {
            "policy_loss": policy_loss,
            "value_loss": value_loss,
            "entropy": entropy,
            # The estimator k3 of Schulman (2020), "Approximating KL divergence".
            "kl": jnp.mean(ratio - 1 - log_ratio),
            "clip_fraction": jnp.mean(jnp.abs(ratio - 1) > config.clip_eps),
        }


def take(leaf: jax.Array, rows: jax.Array, *numbers: slice) -> jax.Array:
    """Of `[T, N, ...]` the steps `[N, R]` of each environment, `[N R, ...]`."""
    found = jax.vmap(lambda x, row: x[row, *numbers], in_axes=(1, 0))(leaf, rows)
    return found.reshape(-1, *found.shape[2:])


def gae(
    rewards: jax.Array,
    values: jax.Array,
    next_values: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    discount: float,
    gae_lambda: float,
) -> jax.Array:
    """`[T, ...]` advantages, GAE(lambda) of Schulman et al. (2016), eq. 16.

    Args:
        rewards: `[T, ...]` of step t.
        values: `[T, ...]` V of the observation before step t.
        next_values: `[T, ...]` V of the observation after step t, before any automatic reset.
        terminated: `[T, ...]` bool, the task ended: what follows is worth nothing.
        truncated: `[T, ...]` bool, time ran out: what follows is worth `next_values`.
        discount: gamma.
        gae_lambda: lambda.
    """
    errors = rewards + discount * jnp.where(terminated, 0.0, next_values) - values
    decays = discount * gae_lambda * ~(terminated | truncated)

    def accumulate(following: jax.Array, inputs: tuple[jax.Array, jax.Array]):
        error, decay = inputs
        advantage = error + decay * following
        return advantage, advantage

    return jax.lax.scan(accumulate, jnp.zeros_like(values[0]), (errors, decays), reverse=True)[1]
