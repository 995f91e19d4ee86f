"""What all algorithms that learn a policy share: settings, with the defaults of PPO, and seams."""

import math
from abc import abstractmethod
from typing import Any, ClassVar, TypeVar

import optax

from vertiwm_jax.config import Count, Positive, Share, settings
from vertiwm_jax.env.action_repeat import ActionRepeat
from vertiwm_jax.rl.learned import DeterministicPolicy, Value
from vertiwm_jax.training import Algorithm

State = TypeVar("State")


@settings
class LearningConfig:
    """How much is experienced, and what networks learn from it."""

    GONE: ClassVar[dict[str, str]] = {
        "normalise_observations": "is now normalize_observations",
        "normalise_rewards": "is now normalize_rewards",
        "transitions": "is now total_timesteps, action_repeat times as many",
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


class PolicyAlgorithm(Algorithm[State]):
    """An algorithm that learns a policy from environments; `data` are their parameters.

    env: a gymnax environment; config: a `LearningConfig`.
    """

    env: Any
    config: Any

    @property
    def batch(self) -> int:
        return self.config.num_envs

    @property
    def timesteps(self) -> int:
        """Steps of 0.1 s, in all environments, in one iteration."""
        held = self.env.times if isinstance(self.env, ActionRepeat) else 1
        return self.config.num_envs * self.config.num_steps * held

    @property
    def iterations(self) -> int:
        """Iterations of the whole training."""
        return math.ceil(self.config.total_timesteps / self.timesteps)

    @abstractmethod
    def policy(self, data: Any, state: State) -> DeterministicPolicy:
        """What `state` has learned."""

    @abstractmethod
    def value(self, data: Any, state: State) -> Value:
        """What `state` expects of its policy."""
