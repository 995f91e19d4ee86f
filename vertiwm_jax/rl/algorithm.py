"""What all algorithms that learn a policy share: settings, environments side by side, and seams."""

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import optax
from flax import struct

from vertiwm_jax import parallel
from vertiwm_jax.config import Count, Positive, Share, settings
from vertiwm_jax.env._gymnax import Environment
from vertiwm_jax.networks.policy import Actor, Critic, ObservationLayout, TanhNormalActor
from vertiwm_jax.rl.policy import DeterministicPolicy, Value
from vertiwm_jax.rl.running_statistics import RunningStatistics
from vertiwm_jax.training import NONE, Algorithm

Metrics = dict[str, jax.Array]
Outcomes = Callable[[dict[str, jax.Array]], Metrics]
"""What to report of an episode, from the `info` of its last step: named scalars."""


@struct.dataclass
class Environments:
    """N running environments.

    state: the environment's own, leaves `[N, ...]`.
    observation: `[N, O]` what the policy sees next, not normalized.
    discounted_return: `[N]` of the running episode so far.
    episode_return, episode_length: `[N]` undiscounted sum of rewards and steps so far.
    """

    state: Any
    observation: jax.Array
    discounted_return: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array


@struct.dataclass
class Steps:
    """Steps of environments, `[..., N]`.

    observation: `[..., N, O]` before the step, not normalized; action: `[..., N, A]` as chosen, 1
        being the end of its range; terminated: what follows is worth nothing; truncated: time ran
        out; discounted_return, episode_return, episode_length: of the episodes, with this step;
        outcomes: leaves `[..., N]`, which mean something where an episode ended.
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    discounted_return: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array
    outcomes: Metrics

    @property
    def done(self) -> jax.Array:
        """`[..., N]` whether an episode ended."""
        return self.terminated | self.truncated

    def episode_metrics(self) -> Metrics:
        """Means over the episodes that ended on all devices, and how many did; `NONE` if none."""

        def sum_of_last(x: jax.Array) -> jax.Array:
            return jnp.sum(jnp.where(self.done, x, 0.0))

        own = {"episode_return": self.episode_return, "episode_length": self.episode_length}
        count = jnp.sum(self.done, dtype=jnp.float32)
        count, sums = parallel.total((count, jax.tree.map(sum_of_last, own | self.outcomes)))
        means = jax.tree.map(lambda x: jnp.where(count, x / jnp.maximum(count, 1), NONE), sums)
        return {"episodes": count, **means}


@settings
class LearningConfig:
    """How much is experienced, and what networks learn from it."""

    GONE: ClassVar[dict[str, str]] = {
        "transitions": "is now total_timesteps, action_repeat times as many"
    }

    total_timesteps: Count = 1_310_720
    """Steps of 0.1 s of the whole training, in all environments; rounded up to iterations."""
    num_envs: Count = 256
    """Environments run side by side."""
    num_steps: Count = 32
    """Actions in each environment in an iteration; each is held for `action_repeat` steps."""
    discount: Share = 0.98
    """Gamma."""
    learning_rate: Positive = 1e-3
    """Of Adam, at the start."""
    max_gradient_norm: Positive = 0.5
    """Gradients are clipped to this global norm."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the layers of the actor and of each critic."""
    normalize_observations: bool = True
    """Whether observations are brought to zero mean and unit variance."""
    normalize_rewards: bool = True
    """Whether rewards are divided by the running deviation of the discounted return."""

    def adam(self, rate: optax.ScalarOrSchedule, eps: float) -> optax.GradientTransformation:
        """Adam with clipped gradients."""
        clip = optax.clip_by_global_norm(self.max_gradient_norm)
        # All weights as one vector, or XLA would compile the same for each of them.
        return optax.flatten(optax.chain(clip, optax.adam(rate, eps=eps)))


@struct.dataclass
class LearningState:
    """What training carries from one iteration to the next, whatever the algorithm.

    iteration: `[]` int32, iterations done. key: `[]` random key.
    observations: statistics of observations, `[O]`; those of no sample if they are used raw.
    returns: statistics of discounted returns, `[]`; likewise.
    environments: where the environments stand.
    """

    iteration: jax.Array
    key: jax.Array
    observations: RunningStatistics
    returns: RunningStatistics
    environments: Environments


S = TypeVar("S", bound=LearningState)


@dataclass(frozen=True)
class PolicyAlgorithm(Algorithm[S]):
    """An algorithm that learns a policy from the episodes of an environment.

    env: a gymnax environment with a flat observation and a bounded Box of actions, static; its
        parameters are the `data` of every function.
    config: a `LearningConfig`.
    outcomes: what to report, averaged over the episodes that end in an iteration.
    layout: how the networks read observations.
    """

    env: Environment
    config: Any
    outcomes: Outcomes = lambda info: {}
    layout: ObservationLayout = ObservationLayout()

    @property
    def batch(self) -> int:
        return self.config.num_envs

    @property
    def timesteps(self) -> int:
        """Steps of 0.1 s, in all environments, in one iteration."""
        held = getattr(self.env, "action_repeat", 1)
        return self.config.num_envs * self.config.num_steps * held

    @property
    def iterations(self) -> int:
        """Iterations of the whole training."""
        return math.ceil(self.config.total_timesteps / self.timesteps)

    @property
    def actions(self) -> int:
        """A, how many numbers an action has."""
        return math.prod(self.env.action_space(None).shape)

    @property
    @abstractmethod
    def actor(self) -> Actor | TanhNormalActor:
        """The network of the policy."""

    @property
    @abstractmethod
    def critic(self) -> Critic:
        """The network of values."""

    @abstractmethod
    def weights(self, state: S) -> tuple[Any, Any]:
        """Of the actor that drives in the end, and of the critic."""

    def policy(self, state: S) -> DeterministicPolicy:
        """What `state` has learned."""
        return DeterministicPolicy(self.actor, self.weights(state)[0], state.observations)

    def value(self, state: S) -> Value:
        """What `state` expects of its policy."""
        return Value(self.critic, self.weights(state)[1], self.policy(state), state.returns.std)

    def start(self, data: Any, reset_key: jax.Array, key: jax.Array) -> dict[str, Any]:
        """The fields of a `LearningState` at the beginning of all episodes; `key` is its own."""
        keys = jax.random.split(reset_key, self.config.num_envs)
        observation, state = jax.vmap(self.env.reset, (0, None))(keys, data)
        zeros = jnp.zeros(len(keys))
        return {
            "iteration": jnp.int32(0),
            "key": key,
            "observations": RunningStatistics.create(observation.shape[1:]),
            "returns": RunningStatistics.create(()),
            "environments": Environments(state, observation, zeros, zeros, zeros),
        }

    def step(
        self, data: Any, environments: Environments, action: jax.Array, keys: jax.Array
    ) -> tuple[Environments, Steps, jax.Array]:
        """A step of N environments; episodes that end begin anew.

        Args:
            action: `[N, A]`, clipped to [-1, 1] and scaled to the environment's range.
            keys: `[N]` random keys.

        Returns:
            The environments after the step, the step, and the observations `[N, O]` after it and
            before any new beginning.
        """
        space = self.env.action_space(data)
        low, high = jnp.asarray(space.low), jnp.asarray(space.high)
        bounded = low + (high - low) * (jnp.clip(action, -1, 1) + 1) / 2
        step_all = parallel.vmap(self.env.step, (0, 0, 0, None))
        observation, state, reward, terminated, truncated, info = step_all(
            keys, environments.state, bounded, data
        )
        steps = Steps(
            observation=environments.observation,
            action=action,
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            discounted_return=self.config.discount * environments.discounted_return + reward,
            episode_return=environments.episode_return + reward,
            episode_length=environments.episode_length + 1,
            outcomes=jax.vmap(self.outcomes)(info),
        )
        totals = steps.discounted_return, steps.episode_return, steps.episode_length
        running = (jnp.where(steps.done, 0.0, total) for total in totals)
        return Environments(state, observation, *running), steps, info["final_observation"]

    def with_statistics(self, state: S, steps: Steps) -> S:
        """The state with these steps in the statistics that are in use."""
        returns, observations = state.returns, state.observations
        if self.config.normalize_rewards:
            returns = returns.update(steps.discounted_return)
        if self.config.normalize_observations:
            observations = observations.update(steps.observation)
        return replace(state, returns=returns, observations=observations)
