"""Learning from what earlier policies did: what SAC and TD3 share, in one compiled program.

Environments are stepped, every step goes into a replay buffer, and gradient steps are made on
batches from it. What a gradient step is, is a `Rule`.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

import jax
import jax.numpy as jnp
import optax
from flax import struct
from gymnax.environments.environment import Environment

from vertiwm_jax import parallel
from vertiwm_jax.config import Count, NotNegative, Share, settings
from vertiwm_jax.networks.policy import ActionCritic, Senses, SquashedActor, twin_values
from vertiwm_jax.rl import collect
from vertiwm_jax.rl.algorithm import LearningConfig, PolicyAlgorithm
from vertiwm_jax.rl.collect import Environments, Metrics, Outcomes, Steps
from vertiwm_jax.rl.learned import MeanAction, TwinValue
from vertiwm_jax.rl.replay import Replay
from vertiwm_jax.rl.running_statistics import RunningStatistics
from vertiwm_jax.training import all_finite

Params = Any


class Twins(Protocol):
    """What a rule has learned: the weights of two critics and of an actor, and these averaged.

    The average drives in the end: single gradient steps throw the actor about.
    """

    @property
    def actor(self) -> Params: ...

    @property
    def averaged(self) -> Params: ...

    @property
    def critics(self) -> Params: ...


Learner = TypeVar("Learner", bound=Twins)


@settings
class OffPolicyConfig(LearningConfig):
    """Settings of an algorithm with a replay buffer; its learning rate is constant."""

    updates: Count = 8
    """Gradient steps after every step of all environments."""
    batch: Count = 512
    """Transitions in a gradient step."""
    capacity: Count = 131_072
    """Transitions that the replay buffer holds; a multiple of num_envs."""
    warm_up: int = 8_192
    """Transitions by random actions before anything is learned."""
    target_rate: Share = 0.005
    """Share of the critics that the target critics take over in a gradient step (tau), and of the
    actor that its average does."""
    restraint: NotNegative = 0.1
    """What the square of actions costs the actor, in units of the mean size of values. Without it
    actors run to the limits of their actions before critics know what those are worth."""

    def check(self):
        if self.capacity % self.num_envs:
            raise ValueError(
                f"capacity: expected a multiple of num_envs, {self.num_envs}, found {self.capacity}"
            )
        if not self.num_envs <= self.warm_up <= self.capacity:
            raise ValueError(
                f"warm_up: expected num_envs, {self.num_envs}, to capacity, {self.capacity}, "
                f"found {self.warm_up}"
            )

    @property
    def shareable(self) -> int:
        return math.gcd(self.num_envs, self.batch)


@struct.dataclass
class Remembered:
    """Transitions as replayed, `[..., B]`.

    observation, following: `[..., B, O]` before and after the step, normalised once they are
    learned from; action: `[..., B, A]` in [-1, 1]; reward, terminated: `[..., B]`.
    """

    observation: jax.Array
    following: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array


@dataclass(frozen=True)
class Networks:
    """Actor, critic and optimiser as a configuration and a task have them."""

    actor: SquashedActor
    critic: ActionCritic
    optimiser: optax.GradientTransformation
    restraint: float

    def twins(self, params: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
        """`[2, ...]` values of actions, as both critics have them."""
        return twin_values(self.critic, params, observation, action)

    def cost(self, action: jax.Array, value: jax.Array) -> jax.Array:
        """What `[B, A]` actions cost an actor beside their values `[B]`: see `restraint`."""
        size = jax.lax.stop_gradient(jnp.mean(jnp.abs(value)))
        return self.restraint * size * jnp.mean(jnp.sum(action**2, axis=-1))

    def init(self, key: jax.Array, observation: jax.Array) -> tuple[Params, Params]:
        """Weights of the actor and of two critics; `observation` `[O]`."""
        actor_key, critic_key = jax.random.split(key)
        action = jnp.zeros(self.actor.actions)
        keys = jax.random.split(critic_key)
        # One after the other, as `loop.train` does with seeds.
        critics = jax.lax.map(lambda key: self.critic.init(key, observation, action), keys)
        return self.actor.init(actor_key, observation), critics

    def fit_critics(
        self, critics: Params, optimiser: Any, batch: Remembered, target: jax.Array
    ) -> tuple[Params, Any, jax.Array]:
        """A gradient step of both towards the values `[B]` that they should have; also the loss."""

        def loss(critics: Params) -> jax.Array:
            values = self.twins(critics, batch.observation, batch.action)
            return 0.5 * jnp.sum(jnp.mean((values - target) ** 2, axis=-1))

        value, gradient = jax.value_and_grad(loss)(critics)
        return *self.descend(gradient, optimiser, critics), value

    def descend(self, gradient: Params, optimiser: Any, params: Params) -> tuple[Params, Any]:
        """A gradient step: the new parameters and the optimiser's new state."""
        updates, optimiser = self.optimiser.update(gradient, optimiser, params)
        return optax.apply_updates(params, updates), optimiser


class Rule(Protocol[Learner]):
    """How an algorithm explores and what it learns from a batch."""

    @property
    def config(self) -> OffPolicyConfig:
        """The algorithm's settings."""
        ...

    def actor(self, actions: int, senses: Senses) -> SquashedActor:
        """The network of the policy."""
        ...

    def init(self, networks: Networks, observation: jax.Array, key: jax.Array) -> Learner:
        """The learner before the first batch; `observation` `[O]`."""
        ...

    def explore(
        self, networks: Networks, learner: Learner, observation: jax.Array, key: jax.Array
    ) -> jax.Array:
        """`[N, O]` normalised observations to `[N, A]` actions in [-1, 1]."""
        ...

    def learn(
        self, networks: Networks, learner: Learner, batch: Remembered, key: jax.Array
    ) -> tuple[Learner, Metrics]:
        """A gradient step on a normalised batch; the metrics are scalars, NaN for none."""
        ...


@struct.dataclass
class OffPolicyState(Generic[Learner]):
    """All that training carries from one iteration to the next.

    iteration: `[]` int32, iterations done. key: `[]` random key.
    learner: of the rule. replay: of `Remembered`.
    observations, returns: statistics, as `ppo.TrainState` has them.
    environments: where the environments stand.
    """

    iteration: jax.Array
    key: jax.Array
    learner: Learner
    replay: Replay
    observations: RunningStatistics
    returns: RunningStatistics
    environments: Environments


@dataclass(frozen=True)
class OffPolicy(PolicyAlgorithm[OffPolicyState[Learner]], Generic[Learner]):
    """A rule on a gymnax environment with a flat observation and a bounded Box of actions.

    env: static; its parameters are an argument of every function.
    outcomes: what to report, averaged over the episodes that end in an iteration.
    senses: how the networks read observations.
    """

    env: Environment
    rule: Rule[Learner]
    outcomes: Outcomes = lambda info: {}
    senses: Senses = Senses()

    @property
    def config(self) -> OffPolicyConfig:
        """The rule's settings."""
        return self.rule.config

    @property
    def batch(self) -> int:
        return self.config.shareable

    def init(self, data: Params, key: jax.Array) -> OffPolicyState[Learner]:
        """The state before the first iteration."""
        key, reset_key, learner_key = jax.random.split(key, 3)
        running = collect.start(self.env, data, self.config.num_envs, reset_key)
        observation = running.observation[0]
        networks = self._networks(data)
        row = Remembered(
            observation=observation,
            following=observation,
            action=jnp.zeros(networks.actor.actions),
            reward=jnp.float32(0),
            terminated=jnp.array(False),
        )
        return OffPolicyState(
            iteration=jnp.int32(0),
            key=key,
            learner=self.rule.init(networks, observation, learner_key),
            replay=Replay.create(row, self.config.capacity),
            observations=RunningStatistics.create(observation.shape),
            returns=RunningStatistics.create(()),
            environments=running,
        )

    def iterate(
        self, data: Params, state: OffPolicyState[Learner]
    ) -> tuple[OffPolicyState[Learner], Metrics]:
        """`num_steps` steps of all environments, each with its gradient steps; jit it, donated.

        The metrics are scalars. Those of episodes are means over the episodes that ended in
        this iteration, NaN if there were none; `finite` says whether all weights still are.
        """
        key, steps_key = jax.random.split(state.key)
        keys = jax.random.split(steps_key, self.config.num_steps)

        def advance(
            state: OffPolicyState[Learner], key: jax.Array
        ) -> tuple[OffPolicyState[Learner], tuple[Steps, Metrics]]:
            collect_key, learn_key = jax.random.split(key)
            with jax.named_scope("collect"):
                state, experience = self._collect(data, state, collect_key)
            with jax.named_scope("update"):
                state, losses = self._learn(data, state, learn_key)
            return state, (experience, losses)

        state, (experience, losses) = jax.lax.scan(advance, state, keys)
        metrics = {
            **jax.tree.map(jnp.nanmean, losses),
            **collect.episode_metrics(experience),
            "reward": jnp.mean(experience.reward),
            "finite": all_finite(state.learner),
        }
        return replace(state, iteration=state.iteration + 1, key=key), metrics

    def policy(self, data: Params, state: OffPolicyState[Learner]) -> MeanAction:
        """What `state` has learned."""
        actor = self._networks(data).actor
        return MeanAction(actor, state.learner.averaged, state.observations)

    def value(self, data: Params, state: OffPolicyState[Learner]) -> TwinValue:
        """What `state` expects of its policy."""
        critic = self._networks(data).critic
        policy, scale = self.policy(data, state), state.returns.std
        return TwinValue(critic, state.learner.critics, policy, scale)

    def _networks(self, data: Params) -> Networks:
        config = self.config
        actions = math.prod(self.env.action_space(data).shape)
        return Networks(
            self.rule.actor(actions, self.senses),
            ActionCritic(config.hidden, self.senses),
            config.adam(config.learning_rate, eps=1e-8),
            config.restraint,
        )

    def _warming_up(self, state: OffPolicyState[Learner]) -> jax.Array:
        """Whether actions are still random, and nothing is learned."""
        return state.replay.filled < self.config.warm_up

    def _collect(
        self, data: Params, state: OffPolicyState[Learner], key: jax.Array
    ) -> tuple[OffPolicyState[Learner], Steps]:
        """A step of all environments, remembered."""
        explore_key, random_key, step_key = jax.random.split(key, 3)
        running, config = state.environments, self.config
        networks = self._networks(data)
        seen = state.observations.normalise(running.observation)
        chosen = self.rule.explore(networks, state.learner, seen, explore_key)
        anything = jax.random.uniform(random_key, chosen.shape, minval=-1.0, maxval=1.0)
        action = jnp.where(self._warming_up(state), anything, chosen)
        keys = jax.random.split(step_key, config.num_envs)
        running, experience, following = collect.step(
            self.env, data, self.outcomes, config.discount, running, action, keys
        )
        rows = Remembered(
            observation=experience.observation,
            following=following,
            action=action,
            reward=experience.reward,
            terminated=experience.terminated,
        )
        returns, observations = state.returns, state.observations
        if config.normalise_rewards:
            returns = returns.update(experience.discounted_return)
        if config.normalise_observations:
            observations = observations.update(experience.observation)
        return replace(
            state,
            replay=state.replay.add(parallel.whole(rows)),
            returns=returns,
            observations=observations,
            environments=running,
        ), experience

    def _learn(
        self, data: Params, state: OffPolicyState[Learner], key: jax.Array
    ) -> tuple[OffPolicyState[Learner], Metrics]:
        """`updates` gradient steps, none while warming up; the metrics are means."""
        networks = self._networks(data)

        def update(learner: Learner, key: jax.Array) -> tuple[Learner, Metrics]:
            sample_key, learn_key = jax.random.split(key)
            batch = parallel.share(state.replay.sample(sample_key, self.config.batch))
            batch = replace(
                batch,
                observation=state.observations.normalise(batch.observation),
                following=state.observations.normalise(batch.following),
                reward=batch.reward / state.returns.std,
            )
            return self.rule.learn(networks, learner, batch, learn_key)

        def updates(learner: Learner) -> tuple[Learner, Metrics]:
            keys = jax.random.split(key, self.config.updates)
            learner, losses = jax.lax.scan(update, learner, keys)
            return learner, jax.tree.map(jnp.nanmean, losses)

        def none(learner: Learner) -> tuple[Learner, Metrics]:
            nothing = jax.eval_shape(updates, learner)[1]
            return learner, jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), nothing)

        learner, losses = jax.lax.cond(self._warming_up(state), none, updates, state.learner)
        return replace(state, learner=learner), losses
