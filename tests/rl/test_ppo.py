import functools
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rl.probes import (
    Constant,
    Delayed,
    Endless,
    Pictured,
    ProbeParams,
    Sign,
    Staggered,
    Target,
)

from vertiwm_jax.networks.policy import ObservationLayout
from vertiwm_jax.rl.ppo import PPO, PPOConfig

CONFIG = PPOConfig(
    total_timesteps=20_000,
    num_envs=16,
    num_steps=16,
    minibatches=2,
    epochs=8,
    discount=0.9,
    hidden=(32,),
    learning_rate=1e-2,
    normalize_observations=False,
    normalize_rewards=False,
)


TARGET = PPO(Target(), PPOConfig(**{**vars(CONFIG), "total_timesteps": 40_000}))


@functools.cache
def compiled(ppo):
    chex.clear_trace_counter()  # chex counts by name
    return jax.jit(ppo.init), jax.jit(chex.assert_max_traces(ppo.iterate, n=1), donate_argnums=1)


def train(ppo, env_params=ProbeParams(), seed=0, iterations=None):
    """The state and the metrics of the last of `iterations`, all by default."""
    init, iterate = compiled(ppo)
    state, metrics = init(env_params, jax.random.key(seed)), {}
    for _ in range(ppo.iterations if iterations is None else iterations):
        state, metrics = iterate(env_params, state)
    return state, metrics


def values(ppo, state, *observations):
    return np.asarray(ppo.value(state)(jnp.array(observations, jnp.float32)[:, None]))


@pytest.mark.parametrize("normalise", [False, True])
def test_constant_reward_is_its_value(normalise):
    config = {"normalize_observations": normalise, "normalize_rewards": False}
    ppo = PPO(Constant(), PPOConfig(**{**vars(CONFIG), **config}))
    state, metrics = train(ppo)
    np.testing.assert_allclose(values(ppo, state, 0.0), 1.0, atol=0.02)
    assert float(metrics["episode_return"]) == 1.0
    assert float(metrics["episode_length"]) == 1.0
    assert float(metrics["episodes"]) == ppo.timesteps


@pytest.mark.parametrize("normalise", [False, True])
def test_value_depends_on_the_observation(normalise):
    config = {"normalize_observations": normalise, "normalize_rewards": normalise}
    ppo = PPO(Sign(), PPOConfig(**{**vars(CONFIG), **config}))
    np.testing.assert_allclose(values(ppo, train(ppo)[0], -1.0, 1.0), [-1.0, 1.0], atol=0.05)


def test_delayed_reward_is_discounted():
    ppo = PPO(Delayed(), CONFIG, outcomes=lambda info: {"last": info["time"]})
    state, metrics = train(ppo)
    np.testing.assert_allclose(values(ppo, state, 0.0, 1.0), [0.9, 1.0], atol=0.03)
    assert float(metrics["last"]) == 2.0
    assert float(metrics["episode_return"]) == 1.0
    assert float(metrics["episodes"]) == ppo.timesteps / 2


@pytest.mark.parametrize("normalise", [False, True])
def test_policy_finds_the_action_that_depends_on_the_observation(normalise):
    config = {"normalize_observations": normalise, "normalize_rewards": normalise}
    ppo = PPO(Target(), PPOConfig(**{**vars(TARGET.config), **config}))
    state, _ = train(ppo)
    # Actions 0 and 2 of [-2, 4] are -1/3 and 1/3 of [-1, 1].
    actions = ppo.policy(state)(jnp.array([[-1.0], [1.0]]))
    np.testing.assert_allclose(actions[:, 0], [-1 / 3, 1 / 3], atol=0.05)


@pytest.mark.integration
def test_truncation_is_bootstrapped_and_termination_is_not():
    endless = PPO(Endless(), CONFIG)
    state, metrics = train(endless, ProbeParams(max_steps_in_episode=5))
    assert float(metrics["episode_length"]) == 5
    np.testing.assert_allclose(values(endless, state, 0.0), 1 / (1 - 0.9), rtol=0.03)

    staggered = PPO(Staggered(), CONFIG)
    state, _ = train(staggered, ProbeParams(max_steps_in_episode=9))
    np.testing.assert_allclose(values(staggered, state, 0.0), 1 / (1 - 0.9), rtol=0.03)

    finite = PPO(Constant(steps=2), CONFIG)
    state, _ = train(finite)
    np.testing.assert_allclose(values(finite, state, 0.0, 1.0), [1.9, 1.0], rtol=0.03)


def test_several_seeds_are_the_single_ones():
    ppo, iterations, env_params = TARGET, 3, ProbeParams()
    keys = jnp.stack([jax.random.key(seed) for seed in (0, 1)])
    states = jax.jit(jax.vmap(ppo.init, (None, 0)))(env_params, keys)
    iterate = jax.jit(jax.vmap(ppo.iterate, (None, 0)))
    for _ in range(iterations):
        states, _ = iterate(env_params, states)
    for seed in (0, 1):
        alone, _ = train(ppo, env_params, seed, iterations)
        together = jax.tree.map(lambda x, seed=seed: x[seed], states.params)
        chex.assert_trees_all_close(together, alone.params, rtol=1e-3, atol=1e-5)


def test_same_seed_same_numbers():
    first, second = (train(TARGET, iterations=2)[0] for _ in range(2))
    chex.assert_trees_all_equal(first, second)


@pytest.mark.parametrize(
    ("schedule", "share"), [("constant", 1.0), ("linear", 0.5), ("cosine", 0.5)]
)
def test_learning_rate_halfway(schedule, share):
    config = PPOConfig(**{**vars(CONFIG), "schedule": schedule})
    ppo = PPO(Constant(), config)
    halfway = ppo.iterations * config.epochs * config.minibatches // 2
    np.testing.assert_allclose(
        ppo.learning_rate_schedule(halfway), share * config.learning_rate, rtol=1e-2
    )


@pytest.mark.parametrize(("minibatches", "parts"), [(7, 1), (2, 3), (16, 2)])
def test_minibatches_and_their_parts_must_divide_the_steps(minibatches, parts):
    with pytest.raises(
        ValueError, match=f"grad_accumulation, {minibatches * parts}, to divide num_steps, 16"
    ):
        PPOConfig(num_envs=4, num_steps=16, minibatches=minibatches, grad_accumulation=parts)


@pytest.mark.integration
def test_an_epoch_learns_from_every_transition_once():
    def mean_loss(minibatches):
        config = PPOConfig(**{**vars(CONFIG), "learning_rate": 1e-12, "minibatches": minibatches})
        return float(train(PPO(Target(), config), iterations=1)[1]["value_loss"])

    losses = [mean_loss(minibatches) for minibatches in (1, 2, 4, 16)]
    np.testing.assert_allclose(losses, losses[0], rtol=1e-5)


def test_a_minibatch_in_parts_gives_the_gradient_of_the_whole():
    def learned(parts):
        config = PPOConfig(**{**vars(CONFIG), "grad_accumulation": parts})
        state, metrics = train(PPO(Target(), config), iterations=2)
        return state.params, metrics

    chex.assert_trees_all_close(learned(4), learned(1), rtol=1e-3, atol=1e-5)


def test_what_is_learned_from_is_what_was_seen():
    changes = {"epochs": 1, "minibatches": 1, "normalize_observations": True}
    config = PPOConfig(**{**vars(CONFIG), **changes})
    ppo = PPO(Pictured(), config, layout=ObservationLayout(image=(4, 4, 1)))
    state, metrics = train(ppo, iterations=20)
    # Ratios of probabilities are 1 if the networks are told of each transition what they had seen.
    assert abs(metrics["kl"]) < 1e-6
    actions = ppo.policy(state)(Pictured.pictured(jnp.array([[-1.0], [1.0]])))
    assert np.ptp(actions) > 0.1


def test_ent_coef_widens_the_policy():
    ppo = PPO(Constant(), PPOConfig(**{**vars(CONFIG), "ent_coef": 0.1}))
    first, last = (train(ppo, iterations=n)[1]["entropy"] for n in (1, 10))
    assert float(last) > float(first) + 0.1


def test_what_has_learned_nothing_leaves_a_controller_as_it_is():
    observations = jnp.array([[-1.0], [0.3], [9.0]])
    ppo = PPO(Target(), CONFIG)
    state = compiled(ppo)[0](ProbeParams(), jax.random.key(0))
    weights = state.params["actor"]["params"]
    still = {**weights, "MLP_0": jax.tree.map(jnp.zeros_like, weights["MLP_0"])}
    state = state.replace(params={**state.params, "actor": {"params": still}})
    learned = ppo.policy(state)
    np.testing.assert_array_equal(learned(observations), jnp.zeros((3, 1)))
    corrected = replace(learned, base=lambda observation, key: observation / 3)
    action = corrected(observations, jax.random.key(1))
    np.testing.assert_allclose(action, [[-1 / 3], [0.1], [1.0]], rtol=1e-6)
