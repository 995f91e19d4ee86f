"""Actor and critic of continuous control: two separate networks and a diagonal Gaussian."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

LOG_STD_BOUNDS = (-4.0, 1.0)
"""The range of the policy's log standard deviation, in units of half the action range."""
_TILE = 4  # cells of an image to a side
_INNER = nn.initializers.orthogonal(math.sqrt(2))


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


@struct.dataclass
class TanhNormal:
    """A Gaussian over numbers whose tanh are actions (Haarnoja et al., 2018, appendix C)."""

    gaussian: Gaussian

    @property
    def mean(self) -> jax.Array:
        """`[..., A]` the tanh of the mean, which is the median action."""
        return jnp.tanh(self.gaussian.mean)

    def sample(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """`[..., A]` one action each in (-1, 1), and their log densities `[...]`."""
        raw = self.gaussian.sample(key)
        # log(1 - tanh^2), in a form that is finite everywhere.
        slope = 2 * (math.log(2) - raw - nn.softplus(-2 * raw))
        return jnp.tanh(raw), self.gaussian.log_prob(raw) - jnp.sum(slope, axis=-1)


class MLP(nn.Module):
    """tanh layers of the given widths and a linear output, orthogonally initialized.

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
            x = nn.tanh(nn.Dense(width, kernel_init=_INNER)(x))
        outer = nn.initializers.orthogonal(self.output_gain)
        return nn.Dense(self.outputs, kernel_init=outer)(x)


@dataclass(frozen=True)
class Candidates:
    """C candidate actions; an observation has the same features of each.

    split: splits observations `[..., O]` into the features of each candidate `[..., C, F]` and
        the rest `[..., R]`.
    actions: the C actions, each of A numbers in [-1, 1].
    """

    split: Callable[[jax.Array], tuple[jax.Array, jax.Array]]
    actions: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class ObservationLayout:
    """How networks read an observation; by default as a plain vector.

    candidates: actions between which networks choose by attention.
    image: shape `(h, w, c)` of an image, of which the last h w c numbers are the `tiles`. Each
        network learns to compress it to 16 numbers. h and w are multiples of 4.
    """

    candidates: Candidates | None = None
    image: tuple[int, int, int] | None = None

    @property
    def parts(self) -> tuple[slice, ...]:
        """The parts of an observation that are read separately: all of it, or the image and the
        rest."""
        if self.image is None:
            return (slice(None),)
        start = -math.prod(self.image)
        return slice(start), slice(start, None)

    def read(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The observation `[..., O]` without its image, and the compressed image, if any.

        Part of a module's compact method.
        """
        if self.image is None:
            return observation, observation[..., :0]
        h, w, c = self.image
        rest, seen = (observation[..., part] for part in self.parts)
        seen = seen.reshape(*seen.shape[:-1], h * w // _TILE**2, _TILE**2 * c)
        return rest, ImageEncoder()(seen)


def tiles(image: jax.Array) -> jax.Array:
    """Cuts `[..., h, w, c]` into tiles of 4 x 4, `[..., h w / 16, 16 c]`, row by row."""
    *batch, h, w, c = image.shape
    split = image.reshape(*batch, h // _TILE, _TILE, w // _TILE, _TILE, c)
    return jnp.swapaxes(split, -4, -3).reshape(*batch, -1, _TILE**2 * c)


class ImageEncoder(nn.Module):
    """Compresses the tiles of an image to 16 numbers: first each tile, then all together.

    It uses matmuls of tiles instead of convolutions, whose gradients would take most of an
    iteration on a CPU. The features of the image already depend on their neighborhood.
    """

    @nn.compact
    def __call__(self, seen: jax.Array) -> jax.Array:
        """`[..., T, F]` tiles to `[..., 16]` in [-1, 1]."""
        x = nn.tanh(nn.Dense(16, kernel_init=_INNER)(seen))
        return nn.tanh(nn.Dense(16, kernel_init=_INNER)(x.reshape(*x.shape[:-2], -1)))


class Attention(nn.Module):
    """Looks at every candidate with the same weights and attends to some.

    What is learned on one candidate holds for all, which needs much less experience.
    """

    hidden: Sequence[int]
    candidates: Candidates

    @nn.compact
    def __call__(
        self, observation: jax.Array, compressed: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """`[..., O]` to features `[..., 2 H + R]` and the mean `[..., A]` of attended actions.

        compressed: the compressed image, which is appended to the rest.
        """
        seen, rest = self.candidates.split(observation)
        rest = jnp.concatenate([rest, compressed], axis=-1)
        first, *more = self.hidden
        context = nn.Dense(first, use_bias=False, kernel_init=_INNER)(rest)
        x = nn.tanh(nn.Dense(first, kernel_init=_INNER)(seen) + context[..., None, :])
        for width in more:
            x = nn.tanh(nn.Dense(width, kernel_init=_INNER)(x))
        score = nn.Dense(1, kernel_init=nn.initializers.orthogonal(0.1))(x)
        share = nn.softmax(score, axis=-2)
        features = [jnp.sum(share * x, axis=-2), _largest(x), rest]
        action = jnp.sum(share * jnp.asarray(self.candidates.actions), axis=-2)
        return jnp.concatenate(features, axis=-1), action


class Actor(nn.Module):
    """`[..., O]` observations to a `Gaussian` over `actions` actions scaled to [-1, 1].

    With candidates the mean corrects the mean of those attended to. The log standard deviation
    is one learned vector, the same in every state, kept within `LOG_STD_BOUNDS` by a sigmoid so
    that its gradient never dies at a bound.
    """

    actions: int
    hidden: Sequence[int]
    initial_log_std: float
    layout: ObservationLayout = ObservationLayout()

    @nn.compact
    def __call__(self, observation: jax.Array) -> Gaussian:
        features, attended, hidden = _look(observation, self.hidden, self.layout)
        mean = attended + MLP(hidden, self.actions, output_gain=0.01)(features)
        initial = nn.initializers.constant(_raw(self.initial_log_std))
        raw = self.param("log_std", initial, (self.actions,))
        return Gaussian(mean, _log_std(raw))


class Critic(nn.Module):
    """`[..., O]` observations, and `[..., A]` actions if it judges those, to `[...]` values."""

    hidden: Sequence[int]
    layout: ObservationLayout = ObservationLayout()

    @nn.compact
    def __call__(self, observation: jax.Array, *action: jax.Array) -> jax.Array:
        features, _, hidden = _look(observation, self.hidden, self.layout)
        inputs = jnp.concatenate([features, *action], axis=-1)
        return MLP(hidden, 1, output_gain=1.0)(inputs)[..., 0]


class TanhNormalActor(nn.Module):
    """`[..., O]` observations to `TanhNormal` Gaussians over actions, whose width is learned too.

    For off-policy algorithms. With candidates the mean corrects the mean of those attended to,
    before the tanh. Without an initial log standard deviation the policy is deterministic.
    """

    actions: int
    hidden: Sequence[int]
    initial_log_std: float | None
    layout: ObservationLayout = ObservationLayout()

    @nn.compact
    def __call__(self, observation: jax.Array) -> TanhNormal:
        features, attended, hidden = _look(observation, self.hidden, self.layout)
        if self.initial_log_std is None:
            mean = attended + MLP(hidden, self.actions, output_gain=0.01)(features)
            return TanhNormal(Gaussian(mean, jnp.full(self.actions, -jnp.inf)))
        outputs = MLP(hidden, 2 * self.actions, output_gain=0.01)(features)
        mean, raw = jnp.split(outputs, 2, axis=-1)
        return TanhNormal(Gaussian(attended + mean, _log_std(raw + _raw(self.initial_log_std))))


def twin_values(
    critic: Critic, params: Any, observation: jax.Array, action: jax.Array
) -> jax.Array:
    """`[2, ...]` values of actions, by two critics whose weights are stacked."""
    values = jax.vmap(critic.apply, (0, None, None))(params, observation, action)
    return cast(jax.Array, values)


def _log_std(raw: jax.Array) -> jax.Array:
    """Any number to a log standard deviation within its bounds."""
    low, high = LOG_STD_BOUNDS
    return low + (high - low) * nn.sigmoid(raw)


def _raw(log_std: float) -> float:
    """The inverse of `_log_std`."""
    low, high = LOG_STD_BOUNDS
    return math.log((log_std - low) / (high - log_std))


def _largest(x: jax.Array) -> jax.Array:
    """`[..., C, F]` to `[..., F]`, the largest of the C.

    The derivative of `jnp.max` looks for entries that equal the maximum. A compiler may compute x
    again for it, with other rounding. Then no entry is equal, and the derivative is NaN.
    """
    chosen = jnp.argmax(x, axis=-2, keepdims=True) == jnp.arange(x.shape[-2])[:, None]
    return jnp.sum(jnp.where(chosen, x, 0.0), axis=-2)


def _look(
    observation: jax.Array, hidden: Sequence[int], layout: ObservationLayout
) -> tuple[jax.Array, jax.Array | float, Sequence[int]]:
    """Features `[..., F]`, the mean of attended actions (0 if there are none), and the layers left.

    Part of a module's compact method.
    """
    observation, compressed = layout.read(observation)
    if layout.candidates is None:
        return jnp.concatenate([observation, compressed], axis=-1), 0.0, hidden
    # Apart: what is learned is learned from the one alone, and the other needs no gradient.
    features, attended = Attention(hidden, layout.candidates)(observation, compressed)
    return features, attended, hidden[-1:]
