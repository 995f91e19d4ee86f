"""Settings that all algorithms have, with the defaults of PPO."""

import math

import optax

from vertiwm_jax.config import Count, Positive, Share, settings


@settings
class LearningConfig:
    """How much is experienced, and what networks learn from it."""

    transitions: Count = 1_500_000
    """Environment steps of the whole training, rounded up to whole iterations."""
    num_envs: Count = 256
    """Environments run side by side."""
    num_steps: Count = 64
    """Steps of each environment in an iteration."""
    discount: Share = 0.99
    """Gamma."""
    learning_rate: Positive = 1e-3
    """Of Adam, at the start."""
    max_gradient_norm: Positive = 0.5
    """Gradients are clipped to this global norm."""
    hidden: tuple[int, ...] = (128, 128)
    """Widths of the layers of the actor and of each critic."""
    normalise_observations: bool = True
    """Whether observations are brought to zero mean and unit variance."""
    normalise_rewards: bool = True
    """Whether rewards are divided by the running deviation of the discounted return."""

    @property
    def collected(self) -> int:
        """Transitions of one iteration."""
        return self.num_envs * self.num_steps

    @property
    def shareable(self) -> int:
        """What divides the sizes of all its batches: that many devices can share them evenly."""
        return self.num_envs

    @property
    def iterations(self) -> int:
        """Iterations of the whole training."""
        return math.ceil(self.transitions / self.collected)

    def adam(self, rate: optax.ScalarOrSchedule, eps: float) -> optax.GradientTransformation:
        """Adam with clipped gradients."""
        clip = optax.clip_by_global_norm(self.max_gradient_norm)
        # All weights as one vector, or XLA would compile the same for each of them.
        return optax.flatten(optax.chain(clip, optax.adam(rate, eps=eps)))
