import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from vertiwm_jax.networks.policy import LOG_STD_BOUNDS, Actor, Critic, Gaussian

RNG = np.random.default_rng(0)
MEAN = RNG.normal(size=(5, 3)).astype(np.float32)
LOG_STD = np.array([-1.5, 0.0, 0.7], np.float32)


def test_log_prob_equals_scipy():
    action = RNG.normal(size=(5, 3)).astype(np.float32)
    expected = scipy.stats.norm.logpdf(action, MEAN, np.exp(LOG_STD)).sum(-1)
    found = Gaussian(jnp.asarray(MEAN), jnp.asarray(LOG_STD)).log_prob(jnp.asarray(action))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_entropy_equals_scipy():
    expected = scipy.stats.multivariate_normal(np.zeros(3), np.diag(np.exp(2 * LOG_STD))).entropy()
    found = Gaussian(jnp.asarray(MEAN), jnp.asarray(LOG_STD)).entropy()
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_samples_have_the_mean_and_deviation_asked_for():
    policy = Gaussian(jnp.broadcast_to(MEAN[0], (20_000, 3)), jnp.asarray(LOG_STD))
    samples = np.asarray(policy.sample(jax.random.key(0)))
    np.testing.assert_allclose(samples.mean(0), MEAN[0], atol=0.05)
    np.testing.assert_allclose(samples.std(0), np.exp(LOG_STD), rtol=0.03)


@pytest.mark.parametrize("initial", [-2.0, -0.5, 0.5])
def test_actor_starts_near_zero_with_the_deviation_asked_for(initial):
    actor = Actor(actions=2, hidden=(16, 16), initial_log_std=initial)
    observation = jax.random.normal(jax.random.key(1), (64, 7))
    policy = actor.apply(actor.init(jax.random.key(0), observation), observation)
    assert policy.mean.shape == (64, 2)
    assert float(jnp.max(jnp.abs(policy.mean))) < 0.1
    np.testing.assert_allclose(policy.log_std, initial, rtol=1e-5)


def test_log_std_stays_within_its_bounds_and_keeps_a_gradient():
    actor = Actor(actions=2, hidden=(4,), initial_log_std=0.0)
    params = actor.init(jax.random.key(0), jnp.zeros(3))

    def deviation(raw):
        moved = {"params": {**params["params"], "log_std": raw}}
        return jnp.sum(actor.apply(moved, jnp.zeros(3)).log_std)

    for raw, bound in ((-5.0, LOG_STD_BOUNDS[0]), (5.0, LOG_STD_BOUNDS[1])):
        assert abs(float(deviation(jnp.full(2, raw))) / 2 - bound) < 0.1
        assert bool(jnp.all(jax.grad(deviation)(jnp.full(2, raw)) > 0.01))
    assert float(deviation(jnp.full(2, 100.0))) <= 2 * LOG_STD_BOUNDS[1]


def test_critic_gives_one_value_for_each_observation():
    critic = Critic(hidden=(8,))
    observation = jnp.ones((3, 4, 5))
    assert critic.apply(critic.init(jax.random.key(0), observation), observation).shape == (3, 4)
