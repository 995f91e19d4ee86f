import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.rl.running_statistics import CLIP, RunningStatistics

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("shape", [(), (3,)])
def test_statistics_of_batches_equal_those_of_all_samples(shape):
    batches = [5 + 3 * RNG.normal(size=(4, size, *shape)).astype(np.float32) for size in (1, 7, 50)]
    statistics = RunningStatistics.create(shape)
    for batch in batches:
        statistics = statistics.update(jnp.asarray(batch))
    samples = np.concatenate([batch.reshape(-1, *shape) for batch in batches])
    assert float(statistics.count) == len(samples)
    np.testing.assert_allclose(statistics.mean, samples.mean(0), rtol=1e-5)
    np.testing.assert_allclose(statistics.variance, samples.var(0), rtol=1e-4)
    normal = statistics.normalize(jnp.asarray(samples))
    np.testing.assert_allclose(np.mean(normal, 0), 0, atol=1e-4)
    np.testing.assert_allclose(np.std(normal, 0), 1, rtol=1e-3)


def test_before_the_first_sample_nothing_changes():
    x = jnp.array([-3.0, 0.0, 2.0])
    np.testing.assert_allclose(RunningStatistics.create((3,)).normalize(x), x, rtol=1e-6)


def test_outliers_are_clipped_and_constants_harmless():
    statistics = RunningStatistics.create(()).update(jnp.full(10, 4.0))
    assert float(statistics.normalize(jnp.float32(4.0))) == 0.0
    assert float(statistics.normalize(jnp.float32(1e9))) == CLIP
