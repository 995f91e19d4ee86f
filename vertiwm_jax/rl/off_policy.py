"""Learning from what earlier policies did: what SAC and TD3 share, in one compiled program.

Environments are stepped, every step goes into a replay buffer, and gradient steps are made on
batches from it.
"""

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct

from vertiwm_jax import parallel
from vertiwm_jax.config import ConfigError, Count, NotNegative, Positive, Share, settings
from vertiwm_jax.networks.policy import Critic, TanhNormal, TanhNormalActor, twin_values
from vertiwm_jax.precision import float32
from vertiwm_jax.rl.algorithm import LearningConfig, LearningState, Metrics, PolicyAlgorithm, Steps
from vertiwm_jax.training import NONE, all_finite

Params = Any


@settings
class OffPolicyConfig(LearningConfig):
    """Settings of an algorithm with a replay buffer; its learning rate is constant."""

    num_envs: Count = 128
    """Environments run side by side."""
    num_steps: Count = 16
    """Actions in each environment in an iteration; each is held for `action_repeat` steps."""
    learning_rate: Positive = 5e-4
    """Of Adam."""
    max_gradient_norm: Positive = 10.0
    """Gradients are clipped to this global norm."""
    updates: Count = 8
    """Gradient steps after every step of all environments."""
    batch: Count = 512
    """Transitions in a gradient step; one is an action, held for `action_repeat` steps."""
    buffer_size: Count = 131_072
    """Transitions that the replay buffer holds; a multiple of num_envs."""
    learning_starts: int = 8_192
    """Transitions by random actions before anything is learned."""
    tau: Share = 0.005
    """Share of the critics that the target critics take over in a gradient step, and of the actor
    that its average does."""
    action_penalty: NotNegative = 0.1
    """What the square of actions costs the actor, in units of the mean size of values. Without it
    actors run to the limits of their actions before critics know what those are worth."""

    def check(self):
        if self.buffer_size % self.num_envs:
            raise ConfigError(
                f"buffer_size: expected a multiple of num_envs, {self.num_envs}, "
                f"found {self.buffer_size}"
            )
        if not self.num_envs <= self.learning_starts <= self.buffer_size:
            raise ConfigError(
                f"learning_starts: expected num_envs, {self.num_envs}, to buffer_size, "
                f"{self.buffer_size}, found {self.learning_starts}"
            )


@struct.dataclass
class Remembered:
    """Transitions as replayed, `[..., B]`.

    observation, following: `[..., B, O]` before and after the step, normalized once they are
    learned from; action: `[..., B, A]` in [-1, 1]; reward, terminated: `[..., B]`.
    """

    observation: jax.Array
    following: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array


@struct.dataclass
class Replay:
    """A ring buffer of rows, kept on the device to be learned from again.

    rows: leaves `[capacity, ...]`; place: `[]` int32 where the next row goes; filled: `[]` int32
    rows that hold something.
    """

    rows: Any
    place: jax.Array
    filled: jax.Array

    @classmethod
    def create(cls, row: Any, capacity: int) -> Self:
        """Room for `capacity` rows like `row`, leaves `[...]`."""
        rows = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), row)
        return cls(rows, jnp.int32(0), jnp.int32(0))

    def add(self, rows: Any) -> Self:
        """With N more rows, leaves `[N, ...]`, in place of the oldest; N divides the capacity."""
        capacity, number = (len(jax.tree.leaves(x)[0]) for x in (self.rows, rows))
        assert capacity % number == 0, (capacity, number)

        def write(ring: jax.Array, new: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_slice_in_dim(ring, new, self.place, axis=0)

        return replace(
            self,
            rows=jax.tree.map(write, self.rows, rows),
            place=(self.place + number) % capacity,
            filled=jnp.minimum(self.filled + number, capacity),
        )

    def sample(self, key: jax.Array, number: int) -> Any:
        """Rows drawn evenly with replacement, leaves `[number, ...]`; it must hold some."""
        chosen = jax.random.randint(key, (number,), 0, self.filled)
        return jax.tree.map(lambda x: x[chosen], self.rows)


@struct.dataclass
class Learner:
    """What both have learned: weights, and the states of Adam.

    averaged: the actor over its updates, which drives in the end, for single gradient steps throw
        the actor about; critics: two, with an axis for them; target: of the critics, behind them;
    extra: what only one algorithm keeps.
    """

    actor: Params
    averaged: Params
    critics: Params
    target: Params
    actor_optimizer: Any
    critic_optimizer: Any
    extra: Any


@struct.dataclass
class OffPolicyState(LearningState):
    """All that training carries from one iteration to the next.

    learner: what was learned; replay: of `Remembered`.
    """

    learner: Learner
    replay: Replay


@dataclass(frozen=True)
class OffPolicy(PolicyAlgorithm[OffPolicyState]):
    """Learns from replayed steps; an algorithm says how it explores and learns from a batch."""

    config: OffPolicyConfig

    @property
    def batch(self) -> int:
        return math.gcd(self.config.num_envs, self.config.batch)

    @property
    def actor(self) -> TanhNormalActor:
        config = self.config
        log_std = getattr(config, "initial_log_std", None)
        return TanhNormalActor(self.actions, config.hidden, log_std, self.layout)

    @property
    def critic(self) -> Critic:
        return Critic(self.config.hidden, self.layout)

    def weights(self, state: OffPolicyState) -> tuple[Params, Params]:
        return state.learner.averaged, state.learner.critics

    @abstractmethod
    def init_extra(self) -> Any:
        """What the learner keeps of its own before the first batch."""

    @abstractmethod
    def explore(self, learner: Learner, observation: jax.Array, key: jax.Array) -> jax.Array:
        """`[N, O]` normalized observations to `[N, A]` actions in [-1, 1]."""

    @abstractmethod
    def learn(self, learner: Learner, batch: Remembered, key: jax.Array) -> tuple[Learner, Metrics]:
        """A gradient step on a normalized batch; the metrics are scalars, or `NONE`."""

    @float32
    def init(self, data: Params, key: jax.Array) -> OffPolicyState:
        """The state before the first iteration."""
        key, reset_key, learner_key = jax.random.split(key, 3)
        begun = self.start(data, reset_key, key)
        observation, action = begun["environments"].observation[0], jnp.zeros(self.actions)
        actor_key, critic_key = jax.random.split(learner_key)
        # One after the other, as `training.Seeds` does with seeds.
        critics = jax.lax.map(
            lambda key: self.critic.init(key, observation, action), jax.random.split(critic_key)
        )
        actor = self.actor.init(actor_key, observation)
        # Targets are copies of their own, for states are donated.
        learner = Learner(
            actor=actor,
            averaged=jax.tree.map(jnp.array, actor),
            critics=critics,
            target=jax.tree.map(jnp.array, critics),
            actor_optimizer=self.optimizer.init(actor),
            critic_optimizer=self.optimizer.init(critics),
            extra=self.init_extra(),
        )
        row = Remembered(observation, observation, action, jnp.float32(0), jnp.array(False))
        replay = Replay.create(row, self.config.buffer_size)
        return OffPolicyState(**begun, learner=learner, replay=replay)

    @float32
    def iterate(self, data: Params, state: OffPolicyState) -> tuple[OffPolicyState, Metrics]:
        """`num_steps` steps of all environments, each with its gradient steps; jit it, donated.

        The metrics are scalars. Those of episodes are means over the episodes that ended in
        this iteration, `NONE` if there were none; `finite` says whether all weights still are.
        """
        key, steps_key = jax.random.split(state.key)
        keys = jax.random.split(steps_key, self.config.num_steps)

        def advance(
            state: OffPolicyState, key: jax.Array
        ) -> tuple[OffPolicyState, tuple[Steps, Metrics]]:
            collect_key, learn_key = jax.random.split(key)
            with jax.named_scope("collect"):
                state, steps = self._collect(data, state, collect_key)
            with jax.named_scope("update"):
                state, losses = self._learn(state, learn_key)
            return state, (steps, losses)

        state, (steps, losses) = jax.lax.scan(advance, state, keys)
        metrics = {
            **jax.tree.map(mean_of_known, losses),
            **steps.episode_metrics(),
            "reward": jnp.mean(steps.reward),
            "finite": all_finite(state.learner),
        }
        return replace(state, iteration=state.iteration + 1, key=key), metrics

    def distribution(self, actor: Params, observation: jax.Array) -> TanhNormal:
        """The policy at normalized observations `[..., O]`."""
        return cast(TanhNormal, self.actor.apply(actor, observation))

    def twins(self, critics: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
        """`[2, ...]` values of actions, as both critics have them."""
        return twin_values(self.critic, critics, observation, action)

    def fit_critics(
        self, learner: Learner, batch: Remembered, later: jax.Array
    ) -> tuple[Learner, jax.Array]:
        """A gradient step of both critics; also the loss.

        later: `[B]` values of what follows, 0 where nothing does.
        """
        target = batch.reward + self.config.discount * jnp.where(batch.terminated, 0.0, later)

        def loss(critics: Params) -> jax.Array:
            values = self.twins(critics, batch.observation, batch.action)
            return 0.5 * jnp.sum(jnp.mean((values - target) ** 2, axis=-1))

        value, gradient = jax.value_and_grad(loss)(learner.critics)
        critics, optimizer = self.descend(gradient, learner.critic_optimizer, learner.critics)
        return replace(learner, critics=critics, critic_optimizer=optimizer), value

    def fit_actor(
        self, learner: Learner, loss: Callable[[Params], tuple[jax.Array, Any]]
    ) -> tuple[Learner, jax.Array, Any]:
        """A gradient step of the actor, after which its average and the targets follow.

        loss: of the actor's weights, with anything beside it; both are given back.
        """
        (value, beside), gradient = jax.value_and_grad(loss, has_aux=True)(learner.actor)
        actor, optimizer = self.descend(gradient, learner.actor_optimizer, learner.actor)
        tau = self.config.tau
        learner = replace(
            learner,
            actor=actor,
            averaged=optax.incremental_update(actor, learner.averaged, tau),
            target=optax.incremental_update(learner.critics, learner.target, tau),
            actor_optimizer=optimizer,
        )
        return learner, value, beside

    def penalty(self, action: jax.Array, value: jax.Array) -> jax.Array:
        """What `[B, A]` actions cost an actor beside their values `[B]`: see `action_penalty`."""
        size = jax.lax.stop_gradient(jnp.mean(jnp.abs(value)))
        return self.config.action_penalty * size * jnp.mean(jnp.sum(action**2, axis=-1))

    def descend(self, gradient: Params, optimizer: Any, params: Params) -> tuple[Params, Any]:
        """A gradient step: the new parameters and the optimizer's new state."""
        updates, optimizer = self.optimizer.update(gradient, optimizer, params)
        return optax.apply_updates(params, updates), optimizer

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Of actor and critics."""
        return self.config.adam(self.config.learning_rate, eps=1e-8)

    def _exploring(self, state: OffPolicyState) -> jax.Array:
        """Whether actions are still random, and nothing is learned."""
        return state.replay.filled < self.config.learning_starts

    def _collect(
        self, data: Params, state: OffPolicyState, key: jax.Array
    ) -> tuple[OffPolicyState, Steps]:
        """A step of all environments, remembered."""
        explore_key, random_key, step_key = jax.random.split(key, 3)
        running = state.environments
        seen = state.observations.normalize(running.observation)
        chosen = self.explore(state.learner, seen, explore_key)
        anything = jax.random.uniform(random_key, chosen.shape, minval=-1.0, maxval=1.0)
        action = jnp.where(self._exploring(state), anything, chosen)
        keys = jax.random.split(step_key, self.config.num_envs)
        running, steps, following = self.step(data, running, action, keys)
        seen = steps.observation
        rows = Remembered(seen, following, action, steps.reward, steps.terminated)
        state = self.with_statistics(state, steps)
        replay = state.replay.add(parallel.placed(rows, parallel.WHOLE))
        return replace(state, replay=replay, environments=running), steps

    def _learn(self, state: OffPolicyState, key: jax.Array) -> tuple[OffPolicyState, Metrics]:
        """`updates` gradient steps, none while exploring; the metrics are means."""

        def update(learner: Learner, key: jax.Array) -> tuple[Learner, Metrics]:
            sample_key, learn_key = jax.random.split(key)
            batch = state.replay.sample(sample_key, self.config.batch)
            batch = parallel.placed(batch, parallel.ROWS)
            batch = replace(
                batch,
                observation=state.observations.normalize(batch.observation),
                following=state.observations.normalize(batch.following),
                reward=batch.reward / state.returns.std,
            )
            return self.learn(learner, batch, learn_key)

        def updates(learner: Learner) -> tuple[Learner, Metrics]:
            keys = jax.random.split(key, self.config.updates)
            learner, losses = jax.lax.scan(update, learner, keys)
            return learner, jax.tree.map(mean_of_known, losses)

        def none(learner: Learner) -> tuple[Learner, Metrics]:
            nothing = jax.eval_shape(updates, learner)[1]
            return learner, jax.tree.map(lambda x: jnp.full(x.shape, NONE, x.dtype), nothing)

        learner, losses = jax.lax.cond(self._exploring(state), none, updates, state.learner)
        return replace(state, learner=learner), losses


def mean_of_known(x: jax.Array) -> jax.Array:
    """The mean of a metric's values, without those that are `NONE`; `NONE` if all are."""
    known = x != NONE
    mean = jnp.sum(jnp.where(known, x, 0)) / jnp.maximum(jnp.sum(known), 1)
    return jnp.where(known.any(), mean, NONE)
