import jax.numpy as jnp
import numpy as np

from vertiwm_jax.rl.ppo import gae

RNG = np.random.default_rng(0)
T, N = 12, 5
REWARDS, VALUES, NEXT_VALUES = RNG.normal(size=(3, T, N)).astype(np.float32)
TERMINATED = RNG.random((T, N)) < 0.2
TRUNCATED = RNG.random((T, N)) < 0.2
DISCOUNT, TRACE = 0.97, 0.9


def test_advantages_equal_a_plain_loop():
    expected = np.zeros((T, N))
    for n in range(N):
        following = 0.0
        for t in reversed(range(T)):
            bootstrap = 0.0 if TERMINATED[t, n] else NEXT_VALUES[t, n]
            error = REWARDS[t, n] + DISCOUNT * bootstrap - VALUES[t, n]
            if TERMINATED[t, n] or TRUNCATED[t, n]:
                following = 0.0
            following = expected[t, n] = error + DISCOUNT * TRACE * following
    arrays = (REWARDS, VALUES, NEXT_VALUES, TERMINATED, TRUNCATED)
    found = gae(*map(jnp.asarray, arrays), DISCOUNT, TRACE)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_a_value_that_is_not_a_number_after_the_end_does_no_harm():
    next_values = jnp.where(TERMINATED, jnp.nan, NEXT_VALUES)
    arrays = (REWARDS, VALUES, next_values, TERMINATED, TRUNCATED)
    found = gae(*map(jnp.asarray, arrays), DISCOUNT, TRACE)
    assert bool(jnp.all(jnp.isfinite(found)))
