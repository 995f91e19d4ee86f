from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from vertiwm_jax.networks import policy
from vertiwm_jax.networks.policy import (
    LOG_STD_BOUNDS,
    Actor,
    Candidates,
    Critic,
    Gaussian,
    ObservationLayout,
    TanhNormal,
    TanhNormalActor,
)

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


def chosen_from(order):
    """Three candidates of two features each, and four other numbers, in this order."""

    def split(observation):
        seen = observation[..., :6].reshape(*observation.shape[:-1], 3, 2)
        return seen[..., jnp.array(order), :], observation[..., 6:]

    actions = ((0.0, -1.0), (0.5, 0.0), (0.0, 1.0))
    return ObservationLayout(Candidates(split, tuple(actions[i] for i in order)))


def trained(network):
    """Weights of a network for 10 numbers, far from what they start as."""
    params = network.init(jax.random.key(0), jnp.zeros(10))
    leaves, structure = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    noisy = [x + jax.random.normal(key, x.shape) for x, key in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(structure, noisy)


def test_candidates_are_alike_whatever_their_order():
    observation = jax.random.normal(jax.random.key(2), (64, 10))
    orders = (0, 1, 2), (2, 0, 1)
    actors = [Actor(2, (16, 16), -1.0, chosen_from(order)) for order in orders]
    critics = [Critic((16, 16), chosen_from(order)) for order in orders]
    for first, second in (actors, critics):
        params = trained(first)
        found = [jax.tree.leaves(n.apply(params, observation))[0] for n in (first, second)]
        np.testing.assert_allclose(*found, rtol=2e-5, atol=2e-5)
        assert float(jnp.std(found[0])) > 0.1


def test_the_action_of_the_candidate_attended_to_is_taken():
    actor = Actor(2, (16, 16), -1.0, chosen_from((0, 1, 2)))
    params = actor.init(jax.random.key(0), jnp.zeros(10))
    layers = params["params"]
    attention = dict(layers["Attention_0"])
    # A score that grows with the first feature of a candidate, and nothing else.
    pick = jnp.zeros((16, 16)).at[0, 0].set(5.0)
    attention["Dense_0"] = {"kernel": jnp.zeros((4, 16))}
    attention["Dense_1"] = {"kernel": pick[:2], "bias": jnp.zeros(16)}
    attention["Dense_2"] = {"kernel": pick, "bias": jnp.zeros(16)}
    attention["Dense_3"] = {"kernel": 40 * pick[:, :1], "bias": jnp.zeros(1)}
    nothing = jax.tree.map(jnp.zeros_like, layers["MLP_0"])
    params = {"params": {**layers, "Attention_0": attention, "MLP_0": nothing}}
    seen = jnp.array([[-1.0, 0, 1, 0, -1, 0], [-1, 0, -1, 0, 1, 0]])
    mean = actor.apply(params, jnp.concatenate([seen, jnp.zeros((2, 4))], -1)).mean
    np.testing.assert_allclose(mean, [[0.5, 0.0], [0.0, 1.0]], atol=1e-4)


def test_the_largest_of_equals_has_one_derivative_and_no_division():
    x = jnp.array([[1.0, 5.0, -2.0], [3.0, 5.0, -3.0], [2.0, 4.0, -2.5]])
    np.testing.assert_array_equal(policy._largest(x), [3.0, 5.0, -2.0])
    slope = jax.grad(lambda x: jnp.sum(policy._largest(x) * jnp.array([1.0, 2.0, 3.0])))
    np.testing.assert_array_equal(slope(x), [[0, 2, 3], [1, 0, 0], [0, 0, 0]])
    # Where a maximum is computed again with other rounding, counting what equals it counts none.
    assert "div" not in str(jax.make_jaxpr(slope)(x))


def test_the_picture_that_an_observation_ends_with_is_compressed():
    shape = (8, 4, 3)
    network = Critic((8,), ObservationLayout(image=shape))
    pixels = jax.random.normal(jax.random.key(0), (5, *shape))
    seen = jnp.concatenate([jnp.ones((5, 2)), pixels.reshape(5, -1)], axis=-1)
    params = network.init(jax.random.key(1), seen)
    # Two numbers beside the 16 that it is compressed to.
    assert params["params"]["MLP_0"]["Dense_0"]["kernel"].shape == (18, 8)
    gradient = jax.grad(lambda x: jnp.sum(network.apply(params, x)))(seen)
    assert bool(jnp.all(gradient != 0))
    gradients = jax.grad(lambda params: jnp.sum(network.apply(params, seen)))(params)
    assert all(
        bool(jnp.any(x != 0)) for x in jax.tree.leaves(gradients["params"]["ImageEncoder_0"])
    )


def test_candidates_are_seen_before_the_picture():
    alone, beside = chosen_from((0, 1, 2)), replace(chosen_from((0, 1, 2)), image=(4, 4, 1))
    actor, params = Actor(2, (16,), -1.0, beside), None
    observation = jax.random.normal(jax.random.key(2), (26,))
    params = actor.init(jax.random.key(0), observation)
    layers = params["params"]
    attention = {**layers["Attention_0"]}
    # A policy that does not care about the picture is the one that is not given it.
    attention["Dense_0"] = {"kernel": attention["Dense_0"]["kernel"].at[4:].set(0.0)}
    kernel = layers["MLP_0"]["Dense_0"]["kernel"].at[-16:].set(0.0)
    mlp = {**layers["MLP_0"], "Dense_0": {**layers["MLP_0"]["Dense_0"], "kernel": kernel}}
    blind = {**layers, "Attention_0": attention, "MLP_0": mlp}
    attention = {**attention, "Dense_0": {"kernel": attention["Dense_0"]["kernel"][:4]}}
    mlp = {**mlp, "Dense_0": {**mlp["Dense_0"], "kernel": kernel[:-16]}}
    small = {"Attention_0": attention, "MLP_0": mlp, "log_std": layers["log_std"]}
    expected = Actor(2, (16,), -1.0, alone).apply({"params": small}, observation[:10])
    found = actor.apply({"params": blind}, observation)
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-5)


def test_density_of_squashed_actions_is_that_of_the_change_of_variables():
    gaussian = Gaussian(jnp.asarray(MEAN), jnp.asarray(LOG_STD))
    action, log_prob = TanhNormal(gaussian).sample(jax.random.key(0))
    assert float(jnp.max(jnp.abs(action))) <= 1
    exact = np.clip(np.asarray(action, np.float64), -1 + 1e-6, 1 - 1e-6)
    density = scipy.stats.norm.logpdf(np.arctanh(exact), MEAN, np.exp(LOG_STD))
    expected = (density - np.log(1 - exact**2)).sum(-1)
    near = np.all(np.abs(exact) < 0.999, axis=-1)
    assert near.sum() >= 2
    np.testing.assert_allclose(np.asarray(log_prob)[near], expected[near], rtol=1e-3, atol=1e-3)
    far = TanhNormal(Gaussian(jnp.full(2, 50.0), jnp.zeros(2))).sample(jax.random.key(1))[1]
    assert bool(jnp.isfinite(far))


def test_squashed_actor_starts_near_zero_with_the_deviation_asked_for():
    actor = TanhNormalActor(actions=2, hidden=(16, 16), initial_log_std=-0.9)
    observation = jax.random.normal(jax.random.key(1), (64, 7))
    policy = actor.apply(actor.init(jax.random.key(0), observation), observation)
    assert policy.mean.shape == (64, 2) and float(jnp.max(jnp.abs(policy.mean))) < 0.1
    np.testing.assert_allclose(policy.gaussian.log_std, -0.9, atol=0.1)


def test_a_certain_actor_draws_what_it_means():
    actor = TanhNormalActor(actions=2, hidden=(16,), initial_log_std=None)
    observation = jax.random.normal(jax.random.key(1), (64, 7))
    policy = actor.apply(actor.init(jax.random.key(0), observation), observation)
    drawn = jnp.tanh(policy.gaussian.sample(jax.random.key(2)))
    np.testing.assert_array_equal(drawn, policy.mean)


def test_a_critic_weighs_actions():
    critic = Critic(hidden=(8,))
    observation, action = jnp.ones((3, 4, 5)), jnp.zeros((3, 4, 2))
    params = critic.init(jax.random.key(0), observation, action)
    value = critic.apply(params, observation, action)
    assert value.shape == (3, 4)
    assert not np.allclose(value, critic.apply(params, observation, action + 0.5))
