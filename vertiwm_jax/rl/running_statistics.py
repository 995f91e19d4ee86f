"""Running mean and variance, and the normalization made from them."""

import dataclasses
import math
from typing import Self

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax import parallel

EPSILON = 1e-8
CLIP = 10.0


@struct.dataclass
class RunningStatistics:
    """Mean and variance of all samples seen so far; mean 0 and variance 1 before the first.

    mean, variance: `[...]`.
    count: `[]` float32, samples seen.
    """

    mean: jax.Array
    variance: jax.Array
    count: jax.Array

    @classmethod
    def create(cls, shape: tuple[int, ...]) -> Self:
        """Statistics of no sample of the given shape."""
        return cls(jnp.zeros(shape), jnp.ones(shape), jnp.zeros(()))

    def update(self, samples: jax.Array) -> Self:
        """Adds `[B..., ...]` samples (any leading axes) of all devices that share a batch.

        By Chan et al. (1979), eq. 2.1.
        """
        batch = samples.shape[: samples.ndim - self.mean.ndim]
        added, within = math.prod(batch) * parallel.sharing(), jnp.float32(0)
        if len(batch) > 1:
            # Sample by sample along the first axis, each row of the others by itself: intermediate
            # results of all take long to write, and devices that share rows need not be waited for.
            own = RunningStatistics.create(samples.shape[1:])
            own = jax.lax.scan(lambda known, x: (known._with(x, 0.0, 1), None), own, samples)[0]
            batch, samples, within = batch[1:], own.mean, own.variance

        def average(x: jax.Array) -> jax.Array:
            # As a product, which a CPU computes several times as fast as sums over first axes.
            total = jnp.tensordot(jnp.ones(batch), x, axes=len(batch), precision="highest")
            return parallel.mean(total / math.prod(batch))

        mean = average(samples)
        return self._with(mean, average(within + (samples - mean) ** 2), added)

    def _with(self, mean: jax.Array, variance: jax.Array | float, added: int) -> Self:
        """With so many samples more, of this mean and variance."""
        count = self.count + added
        share = added / count
        delta = mean - self.mean
        return dataclasses.replace(
            self,
            mean=self.mean + delta * share,
            variance=(1 - share) * self.variance + share * (variance + delta**2 * (1 - share)),
            count=count,
        )

    def of(self, part: slice) -> Self:
        """Of a part of the last axis."""
        return dataclasses.replace(
            self, mean=self.mean[..., part], variance=self.variance[..., part]
        )

    @property
    def std(self) -> jax.Array:
        """`[...]` standard deviation, never 0."""
        return jnp.sqrt(self.variance + EPSILON)

    def normalize(self, x: jax.Array) -> jax.Array:
        """`[..., ...]` to zero mean and unit variance, clipped to +-10."""
        return jnp.clip((x - self.mean) / self.std, -CLIP, CLIP)
