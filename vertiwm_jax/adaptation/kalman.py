"""One update of an iterated extended Kalman filter, which ignores implausible measurements."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Gaussian:
    """A Gaussian belief about N numbers.

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
    """The belief after a measurement of M numbers, and whether it was plausible, `[]` bool.

    residual: function of the `[N]` numbers, `[M]` measurement minus prediction, in standard
        deviations of the measurement. The mean takes `iterations` Gauss-Newton steps (Bell and
        Cathey, 1993), and the covariance is linearized at their end.
    gate: the largest squared Mahalanobis distance of a plausible measurement: that of the
        remaining residual plus that of the step of the mean. A measurement beyond it, or one
        that is not finite, changes nothing.
    longest: largest step in any of the N numbers.

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
