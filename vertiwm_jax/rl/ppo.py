"""Proximal policy optimisation, collection and update in one compiled program.

Schulman et al. (2017), with the details of Andrychowicz et al. (2021). An algorithm is a frozen
object with two pure functions, `init` and `iterate`, over one `TrainState`; several seeds are a
`vmap` of both.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct
from gymnax.environments.environment import Environment

from vertiwm_jax import parallel
from vertiwm_jax.config import Count, NotNegative, Positive, Share, settings
from vertiwm_jax.networks.policy import Actor, Critic, Gaussian, Senses
from vertiwm_jax.rl import environments
from vertiwm_jax.rl.advantages import generalised_advantages
from vertiwm_jax.rl.environments import Environments, Experience, Metrics, Outcomes
from vertiwm_jax.rl.learned import MeanAction, Value
from vertiwm_jax.rl.normalise import RunningStatistics
from vertiwm_jax.rl.settings import LearningConfig
from vertiwm_jax.training import all_finite, mean_in_turns

Params = Any


@settings
class PPOConfig(LearningConfig):
    """Settings of PPO; the defaults suit the navigation task on the built-in simulator."""

    initial_log_std: float = -0.5
    """Log standard deviation of the first policy, in units of half the action range."""
    epochs: Count = 6
    """Passes over the data of an iteration."""
    minibatches: Count = 8
    """Gradient steps in a pass; divides num_envs * num_steps."""
    accumulate: Count = 1
    """Parts of a minibatch whose gradients are computed one after the other, for less memory."""
    trace: Share = 0.95
    """Lambda of the generalised advantage estimator."""
    clip: Positive = 0.2
    """Largest change of the probability ratio that is rewarded."""
    value_clip: float | None = None
    """Largest change of a value in an iteration; none by default."""
    schedule: Literal["constant", "linear", "cosine"] = "linear"
    """How the learning rate goes, to 0 at the end unless constant."""
    value_weight: NotNegative = 0.5
    """Weight of the value loss."""
    entropy_weight: NotNegative = 0.0
    """Weight of the entropy bonus."""

    def check(self):
        if self.collected % self.minibatches:
            divisor = math.gcd(self.minibatches, self.collected)
            raise ValueError(
                f"minibatches: {self.minibatches} does not divide num_envs * num_steps = "
                f"{self.collected}; choose a divisor, for example {divisor}"
            )
        if self.minibatch % self.accumulate:
            raise ValueError(
                f"accumulate: expected a divisor of num_envs * num_steps / minibatches = "
                f"{self.minibatch}, found {self.accumulate}"
            )

    @property
    def minibatch(self) -> int:
        """Transitions of one gradient step."""
        return self.collected // self.minibatches

    @property
    def shareable(self) -> int:
        return math.gcd(self.num_envs, self.minibatch // self.accumulate)

    @property
    def learning_rate_schedule(self) -> optax.Schedule:
        """Learning rate as a function of the gradient steps done."""
        steps = self.iterations * self.epochs * self.minibatches
        return {
            "constant": optax.constant_schedule(self.learning_rate),
            "linear": optax.linear_schedule(self.learning_rate, 0.0, steps),
            "cosine": optax.cosine_decay_schedule(self.learning_rate, steps),
        }[self.schedule]


@struct.dataclass
class TrainState:
    """All that training carries from one iteration to the next.

    iteration: `[]` int32, iterations done.
    key: `[]` random key.
    params: the networks' weights, `{"actor": ..., "critic": ...}`.
    optimiser: the state of Adam.
    observations: statistics of observations, `[O]`; those of no sample if they are used raw.
    returns: statistics of discounted returns, `[]`; likewise.
    environments: where the environments stand.
    """

    iteration: jax.Array
    key: jax.Array
    params: Params
    optimiser: optax.OptState
    observations: RunningStatistics
    returns: RunningStatistics
    environments: Environments


@struct.dataclass
class Transitions:
    """Steps as collected, `[T, N]`, and what the networks of that time made of them.

    log_prob: of the actions, which are not clipped; value, next_value: of what was seen before and
        after the step, unless an episode has terminated.
    """

    experience: Experience
    log_prob: jax.Array
    value: jax.Array
    next_value: jax.Array


@struct.dataclass
class Batch:
    """What the loss is made of, `[T, N]` as collected, or `[B]` of them.

    `target` is a lambda return; observation, advantage: in the loss, normalised.
    """

    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array
    target: jax.Array


@dataclass(frozen=True)
class PPO:
    """PPO on a gymnax environment with a flat observation and a bounded Box of actions.

    env: static; its parameters are an argument of every function.
    outcomes: what to report, averaged over the episodes that end in an iteration.
    senses: how the networks read observations.
    """

    env: Environment
    config: PPOConfig
    outcomes: Outcomes = lambda info: {}
    senses: Senses = Senses()

    def init(self, env_params: Params, key: jax.Array) -> TrainState:
        """The state before the first iteration."""
        key, reset_key, actor_key, critic_key = jax.random.split(key, 4)
        running = environments.start(self.env, env_params, self.config.num_envs, reset_key)
        observation = running.observation
        params = {
            "actor": self._actor(env_params).init(actor_key, observation[0]),
            "critic": self._critic.init(critic_key, observation[0]),
        }
        return TrainState(
            iteration=jnp.zeros((), jnp.int32),
            key=key,
            params=params,
            optimiser=self._optimiser.init(params),
            observations=RunningStatistics.create(observation.shape[1:]),
            returns=RunningStatistics.create(()),
            environments=running,
        )

    def iterate(self, env_params: Params, state: TrainState) -> tuple[TrainState, Metrics]:
        """Collects transitions and learns from them; jit it with `state` donated.

        The metrics are scalars. Those of episodes are means over the episodes that ended in
        this iteration, NaN if there were none; `finite` says whether all weights still are.
        """
        key, collect_key, update_key = jax.random.split(state.key, 3)
        with jax.named_scope("collect"):
            running, transitions = self._collect(env_params, state, collect_key)
        with jax.named_scope("advantages"):
            experience = transitions.experience
            returns, observations = state.returns, state.observations
            if self.config.normalise_rewards:
                returns = returns.update(experience.discounted_return)
            if self.config.normalise_observations:
                # From the next iteration on: within one, all are normalised alike.
                observations = observations.update(experience.observation)
            batch = self._batch(state, returns, transitions)
        with jax.named_scope("update"):
            params, optimiser, losses = self._update(env_params, state, batch, update_key)
        metrics = {
            **losses,
            **environments.episodes(experience),
            "reward": jnp.mean(experience.reward),
            "explained_variance": 1 - jnp.var(batch.target - batch.value) / jnp.var(batch.target),
            "finite": all_finite((params, losses)),
        }
        state = TrainState(
            iteration=state.iteration + 1,
            key=key,
            params=params,
            optimiser=optimiser,
            observations=observations,
            returns=returns,
            environments=running,
        )
        return state, metrics

    def policy(self, env_params: Params, state: TrainState) -> MeanAction:
        """What `state` has learned."""
        actor, params = self._actor(env_params), state.params["actor"]
        return MeanAction(actor, params, state.observations)

    def value(self, env_params: Params, state: TrainState) -> Value:
        """What `state` expects of its policy."""
        del env_params  # which other algorithms need
        params, scale = state.params["critic"], state.returns.std
        return Value(self._critic, params, state.observations, scale)

    def _actor(self, env_params: Params) -> Actor:
        actions = math.prod(self.env.action_space(env_params).shape)
        config = self.config
        return Actor(actions, config.hidden, config.initial_log_std, self.senses)

    @property
    def _critic(self) -> Critic:
        return Critic(self.config.hidden, self.senses)

    @property
    def _optimiser(self) -> optax.GradientTransformation:
        return self.config.adam(self.config.learning_rate_schedule, eps=1e-5)

    def _value(self, params: Params, observation: jax.Array) -> jax.Array:
        return cast(jax.Array, self._critic.apply(params["critic"], observation))

    def _collect(
        self, env_params: Params, state: TrainState, key: jax.Array
    ) -> tuple[Environments, Transitions]:
        """T steps of N environments with the policy as it is."""
        actor, config = self._actor(env_params), self.config

        def advance(running: Environments, key: jax.Array) -> tuple[Environments, Transitions]:
            action_key, step_key = jax.random.split(key)
            seen = state.observations.normalise(running.observation)
            policy = cast(Gaussian, actor.apply(state.params["actor"], seen))
            action = policy.sample(action_key)
            running, experience, final = environments.step(
                self.env, env_params, self.outcomes, config.discount, running, action, step_key
            )
            value = self._value(state.params, seen)
            last = value_of_last(value_of, final, experience.truncated)
            return running, Transitions(experience, policy.log_prob(action), value, last)

        def if_any_truncated(value: Value, final: jax.Array, truncated: jax.Array) -> jax.Array:
            zeros = jnp.zeros(len(final))
            return jax.lax.cond(jnp.any(truncated), lambda: value(final), lambda: zeros)

        value_of = replace(self.value(env_params, state), scale=jnp.float32(1))
        # They are few; all others are valued one step later. Devices need not wait for each other.
        value_of_last = parallel.shard(
            if_any_truncated, (parallel.WHOLE, parallel.ROWS, parallel.ROWS), parallel.ROWS
        )
        keys = jax.random.split(key, self.config.num_steps)
        running, transitions = jax.lax.scan(advance, state.environments, keys)
        following = value_of(running.observation)
        following = jnp.concatenate([transitions.value[1:], following[None]])
        done = transitions.experience.done
        next_value = jnp.where(done, transitions.next_value, following)
        return running, replace(transitions, next_value=next_value)

    def _batch(
        self, state: TrainState, returns: RunningStatistics, transitions: Transitions
    ) -> Batch:
        """Transitions to what the loss is made of, `[T, N]`."""
        experience = transitions.experience
        advantage = generalised_advantages(
            experience.reward / returns.std,
            transitions.value,
            transitions.next_value,
            experience.terminated,
            experience.truncated,
            self.config.discount,
            self.config.trace,
        )
        return Batch(
            observation=experience.observation,
            action=experience.action,
            log_prob=transitions.log_prob,
            value=transitions.value,
            advantage=advantage,
            target=advantage + transitions.value,
        )

    def _update(
        self, env_params: Params, state: TrainState, batch: Batch, key: jax.Array
    ) -> tuple[Params, optax.OptState, Metrics]:
        """`epochs` passes of `minibatches` gradient steps; the losses are means over all.

        Minibatches have as many rows of each group of environments, which are `shareable`: devices
        that share out the groups need none of each other's observations.
        """
        config = self.config
        groups = config.shareable
        batch = jax.tree.map(lambda x: x.reshape(len(x), groups, -1, *x.shape[2:]), batch)

        def chosen(leaf: jax.Array, rows: jax.Array, *numbers: slice) -> jax.Array:
            """Of `[T, G, N / G, ...]` the rows `[G, R]` of each group, `[G R, ...]`."""

            def of_group(x: jax.Array, row: jax.Array) -> jax.Array:
                return x[*jnp.divmod(row, leaf.shape[2]), *numbers]

            found = jax.vmap(of_group, in_axes=(1, 0))(leaf, rows)
            return parallel.share(found.reshape(-1, *found.shape[2:]))

        def seen(rows: jax.Array) -> jax.Array:
            """Chosen observations, normalised."""
            # Not before, and each part by itself, so that it is normalised while it is copied:
            # copies of observations take long to write.
            return jnp.concatenate(
                [
                    state.observations.of(part).normalise(chosen(batch.observation, rows, part))
                    for part in self.senses.parts
                ],
                axis=-1,
            )

        actor, optimiser = self._actor(env_params), self._optimiser

        def loss(params: Params, batch: Batch) -> tuple[jax.Array, Metrics]:
            policy = cast(Gaussian, actor.apply(params["actor"], batch.observation))
            log_ratio = policy.log_prob(batch.action) - batch.log_prob
            ratio = jnp.exp(log_ratio)
            clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
            policy_loss = -jnp.mean(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))

            value = self._value(params, batch.observation)
            error = (value - batch.target) ** 2
            if config.value_clip is not None:
                change = jnp.clip(value - batch.value, -config.value_clip, config.value_clip)
                error = jnp.maximum(error, (batch.value + change - batch.target) ** 2)
            value_loss = 0.5 * jnp.mean(error)

            entropy = policy.entropy()
            total = policy_loss + config.value_weight * value_loss - config.entropy_weight * entropy
            return total, {
                "policy_loss": policy_loss,
                "value_loss": value_loss,
                "entropy": entropy,
                # The estimator k3 of Schulman (2020), "Approximating KL divergence".
                "kl": jnp.mean(ratio - 1 - log_ratio),
                "clip_fraction": jnp.mean(jnp.abs(ratio - 1) > config.clip),
            }

        def descend(carry: tuple[Params, optax.OptState], minibatch: tuple[jax.Array, ...]):
            (params, optimiser_state), (rows, mean, deviation) = carry, minibatch

            def of_part(rows: jax.Array) -> tuple[Params, Metrics]:
                part = jax.tree.map(lambda leaf: chosen(leaf, rows), batch)
                advantage = (part.advantage - mean) / (deviation + 1e-8)
                part = replace(part, observation=seen(rows), advantage=advantage)
                return jax.grad(loss, has_aux=True)(params, part)

            gradients, losses = mean_in_turns(of_part, rows)
            updates, optimiser_state = optimiser.update(gradients, optimiser_state, params)
            return (optax.apply_updates(params, updates), optimiser_state), losses

        rows = self._minibatches(key)
        # Of all minibatches at once, lest devices wait for each other twice more in each.
        advantage = jax.vmap(jax.vmap(partial(chosen, batch.advantage)))(rows)
        mean, deviation = jnp.mean(advantage, axis=(1, 2)), jnp.std(advantage, axis=(1, 2))
        (params, optimiser_state), losses = jax.lax.scan(
            descend, (state.params, state.optimiser), (rows, mean, deviation)
        )
        return params, optimiser_state, jax.tree.map(jnp.mean, losses)

    def _minibatches(self, key: jax.Array) -> jax.Array:
        """`[epochs * minibatches, accumulate, G, R]` rows of each group, all once an epoch."""
        config, groups = self.config, self.config.shareable
        shuffle = jax.vmap(lambda key: jax.random.permutation(key, config.collected // groups))
        rows = shuffle(jax.random.split(key, config.epochs * groups))
        rows = rows.reshape(config.epochs, groups, config.minibatches, config.accumulate, -1)
        return jnp.moveaxis(rows, 1, 3).reshape(-1, config.accumulate, groups, rows.shape[-1])
