"""One measurement of an iterated extended Kalman filter, which ignores what cannot be."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Gaussian:
    """What is believed of N numbers.

    mean: `[..., N]`. covariance: `[..., N, N]`.
    """

    mean: jax.Array
    covariance: jax.Array


def correct(
    prior: Gaussian,
    residual: Callable[[jax.Array], jax.Array],
    gate: float,
    iterations: int = 1,
    longest: float = jnp.inf,
) -> tuple[Gaussian, jax.Array]:
    """The belief after a measurement of M numbers, and `[]` bool, whether it was plausible.

    residual: from `[N]` to `[M]`, what was measured less what these predict, in standard
        deviations of the measurement. The mean takes as many Gauss-Newton steps as there are
        iterations (Bell and Cathey, 1993); the covariance is linearised where they end.
    gate: the largest squared Mahalanobis distance of a plausible residual: what the posterior
        mean still misses and how far it went, both in standard deviations. Of a measurement
        beyond it, or of one that is not finite, nothing is learned.
    longest: a step in any of the N numbers.

    Joseph's form keeps the covariance symmetric and positive in float32.
    """

    def iterate(mean: jax.Array, _: None) -> tuple[jax.Array, tuple[jax.Array, Gaussian]]:
        slope, missed = jax.jacfwd(lambda x: (residual(x),) * 2, has_aux=True)(mean)
        moved = mean - prior.mean
        distance = missed @ missed + moved @ jnp.linalg.solve(prior.covariance, moved)
        across = -slope @ prior.covariance
        gain = jnp.linalg.solve(jnp.eye(missed.size) - across @ slope.T, across).T
        kept = jnp.eye(mean.size) + gain @ slope
        covariance = kept @ prior.covariance @ kept.T + gain @ gain.T
        step = gain @ (missed - slope @ moved) - moved
        here = Gaussian(mean, (covariance + covariance.T) / 2)
        return mean + jnp.clip(step, -longest, longest), (distance, here)

    # The last pass takes no step: it tells where the others have led.
    _, passes = jax.lax.scan(iterate, prior.mean, length=iterations + 1)
    distance, posterior = jax.tree.map(lambda x: x[-1], passes)
    plausible = distance <= gate
    return jax.tree.map(lambda x, y: jnp.where(plausible, x, y), posterior, prior), plausible
