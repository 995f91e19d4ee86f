"""Actor and critic of continuous control: two separate MLPs and a diagonal Gaussian."""

import math
from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

LOG_STD_BOUNDS = (-4.0, 1.0)
"""The range of the policy's log standard deviation, in units of half the action range."""


@struct.dataclass
class Gaussian:
    """A Gaussian with diagonal covariance over actions.

    mean: `[..., A]`.
    log_std: `[A]` or `[..., A]`, log of the standard deviation.
    """

    mean: jax.Array
    log_std: jax.Array

    def sample(self, key: jax.Array) -> jax.Array:
        """`[..., A]` one draw for each mean."""
        noise = jax.random.normal(key, self.mean.shape, self.mean.dtype)
        return self.mean + jnp.exp(self.log_std) * noise

    def log_prob(self, action: jax.Array) -> jax.Array:
        """`[..., A]` actions to `[...]` log densities."""
        z = (action - self.mean) * jnp.exp(-self.log_std)
        return -jnp.sum(0.5 * z**2 + self.log_std + 0.5 * math.log(2 * math.pi), axis=-1)

    def entropy(self) -> jax.Array:
        """`[...]` (or `[]` if log_std has no batch axes) differential entropy, nats."""
        return jnp.sum(self.log_std + 0.5 * math.log(2 * math.pi * math.e), axis=-1)


class MLP(nn.Module):
    """tanh layers of the given widths and a linear output, orthogonally initialised.

    Orthogonal weights, gain sqrt(2) inside and `output_gain` at the end, are what PPO is
    known to need (Andrychowicz et al., 2021, "What matters in on-policy RL", sec. 3.2).
    """

    hidden: Sequence[int]
    outputs: int
    output_gain: float

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """`[..., I]` features to `[..., outputs]`."""
        for width in self.hidden:
            x = nn.tanh(nn.Dense(width, kernel_init=nn.initializers.orthogonal(math.sqrt(2)))(x))
        kernel_init = nn.initializers.orthogonal(self.output_gain)
        return nn.Dense(self.outputs, kernel_init=kernel_init)(x)


class Actor(nn.Module):
    """`[..., O]` observations to a `Gaussian` over `actions` actions scaled to [-1, 1].

    The log standard deviation is one learned vector, the same in every state, kept within
    `LOG_STD_BOUNDS` by a sigmoid so that its gradient never dies at a bound.
    """

    actions: int
    hidden: Sequence[int]
    initial_log_std: float

    @nn.compact
    def __call__(self, observation: jax.Array) -> Gaussian:
        mean = MLP(self.hidden, self.actions, output_gain=0.01)(observation)
        low, high = LOG_STD_BOUNDS
        share = (self.initial_log_std - low) / (high - low)
        initial = nn.initializers.constant(math.log(share / (1 - share)))
        raw = self.param("log_std", initial, (self.actions,))
        return Gaussian(mean, low + (high - low) * nn.sigmoid(raw))


class Critic(nn.Module):
    """`[..., O]` observations to `[...]` values."""

    hidden: Sequence[int]

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        return MLP(self.hidden, 1, output_gain=1.0)(observation)[..., 0]
