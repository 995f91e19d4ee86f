import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.adaptation import kalman
from vertiwm_jax.adaptation.kalman import Gaussian

N, M = 6, 4
FAR = 1e9


def problem(seed):
    """A prior, a measurement with its matrix and standard deviations."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(N, N))
    covariance = root @ root.T + 0.1 * np.eye(N)
    matrix, noise = rng.normal(size=(M, N)), rng.uniform(0.1, 1, M)
    return rng.normal(size=N), covariance, matrix, noise, rng.normal(size=M)


def corrected(mean, covariance, matrix, noise, measured, gate=FAR, **settings):
    prior = Gaussian(jnp.asarray(mean, jnp.float32), jnp.asarray(covariance, jnp.float32))
    return kalman.correct(prior, lambda x: (measured - matrix @ x) / noise, gate, **settings)


def textbook(mean, covariance, matrix, noise, measured):
    """Kalman (1960) in float64, and the squared Mahalanobis distance of the innovation."""
    spread = matrix @ covariance @ matrix.T + np.diag(noise**2)
    gain = covariance @ matrix.T @ np.linalg.inv(spread)
    innovation = measured - matrix @ mean
    distance = innovation @ np.linalg.inv(spread) @ innovation
    return mean + gain @ innovation, covariance - gain @ matrix @ covariance, distance


@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize("seed", [0, 1])
def test_of_a_linear_measurement_it_is_kalmans_filter(seed, iterations):
    values = problem(seed)
    mean, covariance, _ = textbook(*values)
    found, plausible = corrected(*values, iterations=iterations)
    assert plausible
    np.testing.assert_allclose(found.mean, mean, atol=1e-5)
    np.testing.assert_allclose(found.covariance, covariance, atol=1e-5)


def test_a_hundred_measurements_are_kalmans_too_and_the_covariance_stays_one():
    mean, covariance, *_ = problem(0)
    rng = np.random.default_rng(1)
    found = Gaussian(jnp.asarray(mean, jnp.float32), jnp.asarray(covariance, jnp.float32))
    measure = jax.jit(
        lambda x, matrix, measured: corrected(x.mean, x.covariance, matrix, 0.01, measured)[0]
    )
    for _ in range(100):
        matrix, measured = rng.normal(size=(1, N)), rng.normal(size=1)
        mean, covariance, _ = textbook(mean, covariance, matrix, np.array([0.01]), measured)
        found = measure(found, matrix, measured)
        assert np.array_equal(found.covariance, found.covariance.T)
        assert np.linalg.eigvalsh(np.asarray(found.covariance, np.float64)).min() > 0
    np.testing.assert_allclose(found.mean, mean, atol=2e-2)


def test_the_gate_is_at_the_mahalanobis_distance():
    values = problem(2)
    *_, distance = textbook(*values)
    _, inside = corrected(*values, gate=1.001 * distance)
    found, outside = corrected(*values, gate=0.999 * distance)
    assert inside and not outside
    np.testing.assert_array_equal(found.mean, np.float32(values[0]))
    np.testing.assert_array_equal(found.covariance, np.float32(values[1]))


def test_of_what_is_not_finite_nothing_is_learned():
    mean, *values, measured = problem(3)
    covariance, matrix, noise = values
    found, plausible = corrected(mean, covariance, matrix, noise, measured * np.nan)
    assert not plausible
    np.testing.assert_array_equal(found.mean, np.float32(mean))


def test_iterations_end_where_prior_and_measurement_agree_best():
    prior = Gaussian(jnp.zeros(1), jnp.eye(1))

    def residual(x):
        return (jnp.exp(2.0) - jnp.exp(x)) / 0.1

    def cost(x):
        return x**2 + float(residual(x)) ** 2

    found, _ = kalman.correct(prior, residual, FAR, iterations=10)
    best = min(np.linspace(0, 4, 4001), key=cost)
    assert float(found.mean[0]) == pytest.approx(best, abs=2e-3)
    extended, _ = kalman.correct(prior, residual, FAR)
    assert abs(float(extended.mean[0]) - best) > 1
    short, _ = kalman.correct(prior, residual, FAR, iterations=2, longest=0.25)
    assert float(short.mean[0]) == 0.5


def test_beliefs_are_batched():
    means = jnp.arange(12.0).reshape(2, N)
    prior = Gaussian(means, jnp.broadcast_to(jnp.eye(N), (2, N, N)))
    together, _ = jax.vmap(lambda x: kalman.correct(x, lambda y: y[:M] - 1, FAR))(prior)
    for i in range(2):
        alone, _ = kalman.correct(Gaussian(means[i], jnp.eye(N)), lambda y: y[:M] - 1, FAR)
        np.testing.assert_allclose(together.mean[i], alone.mean, rtol=1e-6)
