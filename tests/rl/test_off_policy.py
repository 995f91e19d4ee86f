"""SAC and TD3 on environments whose solutions are known."""

import functools
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rl.probes import Broken, Delayed, Endless, ProbeParams, Sign, Target

from vertiwm_jax.rl.sac import SAC, SACConfig
from vertiwm_jax.rl.td3 import TD3, TD3Config
from vertiwm_jax.training import NONE

SETTINGS = {
    "total_timesteps": 4096,
    "num_envs": 16,
    "num_steps": 16,
    "updates": 8,
    "batch": 64,
    "buffer_size": 4096,
    "learning_starts": 512,
    "discount": 0.9,
    "tau": 0.05,
    "learning_rate": 2e-3,
    "max_gradient_norm": 10.0,
    "hidden": (64, 64),
    "normalize_observations": False,
    "normalize_rewards": False,
    "action_penalty": 0.0,
}
CONFIGS = {
    "sac": SACConfig(
        **SETTINGS, initial_log_std=-0.9, initial_temperature=0.05, target_entropy=-2.0
    ),
    "td3": TD3Config(**SETTINGS),
}
TARGET = {"env": Target(), "normalize_rewards": True}
each = pytest.mark.parametrize("name", CONFIGS)


def algorithm(name, env, **settings):
    config = replace(CONFIGS[name], **settings)
    kind = SAC if isinstance(config, SACConfig) else TD3
    return kind(env, config, outcomes=lambda info: {"last": info["time"]})


@functools.cache
def compiled(algorithm):
    chex.clear_trace_counter()  # chex counts by name
    iterate = chex.assert_max_traces(algorithm.iterate, n=1)
    return jax.jit(algorithm.init), jax.jit(iterate, donate_argnums=1)


def train(algorithm, env_params=ProbeParams(), iterations=None):
    """The state and the metrics of the last of `iterations`, all by default."""
    init, iterate = compiled(algorithm)
    state, metrics = init(env_params, jax.random.key(0)), {}
    for _ in range(algorithm.iterations if iterations is None else iterations):
        state, metrics = iterate(env_params, state)
    return state, metrics


def values(algorithm, state, *observations):
    value = algorithm.value(state)
    return np.asarray(value(jnp.array(observations, jnp.float32)[:, None]))


@each
@pytest.mark.integration
def test_value_depends_on_the_observation(name):
    sign = algorithm(name, Sign(), normalize_observations=True, normalize_rewards=True)
    np.testing.assert_allclose(values(sign, train(sign)[0], -1.0, 1.0), [-1, 1], atol=0.1)


@each
@pytest.mark.integration
def test_delayed_reward_is_discounted(name):
    # The entropy that is to come is a part of SAC's values: here it is next to nothing.
    quiet = {"initial_temperature": 1e-9, "target_entropy": -20.0} if name == "sac" else {}
    delayed = algorithm(name, Delayed(), **quiet)
    state, metrics = train(delayed)
    np.testing.assert_allclose(values(delayed, state, 0.0, 1.0), [0.9, 1.0], atol=0.05)
    assert float(metrics["last"]) == 2.0
    assert float(metrics["episodes"]) == delayed.timesteps / 2


@each
@pytest.mark.integration
def test_truncation_is_bootstrapped(name):
    quiet = {"initial_temperature": 1e-9, "target_entropy": -20.0} if name == "sac" else {}
    endless = algorithm(name, Endless(), tau=0.2, total_timesteps=8192, **quiet)
    state, metrics = train(endless, ProbeParams(max_steps_in_episode=5))
    assert float(metrics["episode_length"]) == 5
    np.testing.assert_allclose(values(endless, state, 0.0), 1 / (1 - 0.9), rtol=0.08)


@each
@pytest.mark.integration
def test_policy_finds_the_action_that_depends_on_the_observation(name):
    target = algorithm(name, **TARGET)
    state, metrics = train(target)
    # Actions 0 and 2 of [-2, 4] are -1/3 and 1/3 of [-1, 1].
    actions = target.policy(state)(jnp.array([[-1.0], [1.0]]))
    np.testing.assert_allclose(actions[:, 0], [-1 / 3, 1 / 3], atol=0.1)
    if name == "sac":  # the temperature keeps the entropy asked for
        assert abs(float(metrics["entropy"]) + 2) < 0.5
        assert float(metrics["temperature"]) != pytest.approx(0.05, rel=0.2)


@each
@pytest.mark.integration
def test_a_penalty_keeps_actions_small_unless_more_are_worth_it(name):
    target, observations = (
        algorithm(name, **TARGET, action_penalty=100.0),
        jnp.array([[-1.0], [1.0]]),
    )
    state, _ = train(target)
    np.testing.assert_allclose(target.policy(state)(observations), 0.0, atol=0.05)


@each
@pytest.mark.integration
def test_nothing_is_learned_while_warming_up(name):
    target = algorithm(name, **TARGET)
    first = compiled(target)[0](ProbeParams(), jax.random.key(0)).learner
    one, metrics = train(target, iterations=1)
    assert metrics["value_loss"] == NONE and bool(metrics["finite"])
    chex.assert_trees_all_equal(one.learner, first)
    assert int(one.replay.filled) == 256
    actions = np.asarray(one.replay.rows.action[:256])
    assert actions.min() < -0.9 and actions.max() > 0.9 and abs(actions.mean()) < 0.15
    two, metrics = train(target, iterations=2)  # whose last step has what is needed
    assert np.isfinite(metrics["value_loss"])
    if name == "td3":
        assert int(two.learner.extra) == target.config.updates


@each
@pytest.mark.integration
def test_an_average_of_the_actor_drives(name):
    single = {"policy_delay": 1} if name == "td3" else {}
    target = algorithm(name, **TARGET, updates=1, tau=0.25, **single)
    first = compiled(target)[0](ProbeParams(), jax.random.key(0)).learner.actor
    state, _ = train(target, iterations=2)  # one gradient step: see above
    average = jax.tree.map(lambda x, y: 0.75 * x + 0.25 * y, first, state.learner.actor)
    chex.assert_trees_all_close(target.policy(state).params, average, atol=1e-7)
    with pytest.raises(AssertionError):
        chex.assert_trees_all_close(state.learner.actor, average, atol=1e-7)


def test_a_reward_that_is_no_number_is_noticed():
    broken = algorithm("td3", Broken(), normalize_rewards=True)
    _, metrics = train(broken, iterations=4)
    assert not bool(metrics["finite"])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"buffer_size": 100}, "buffer_size: expected a multiple of num_envs, 16, found 100"),
        (
            {"learning_starts": 8},
            "learning_starts: expected num_envs, 16, to buffer_size, 4096, found 8",
        ),
        ({"updates": 0}, "updates: expected at least 1, found 0"),
        ({"action_penalty": -1.0}, "action_penalty: expected at least 0, found -1"),
    ],
)
def test_settings_that_cannot_be_are_named(settings, words):
    with pytest.raises(ValueError, match=words):
        SACConfig(**{**SETTINGS, **settings})
    with pytest.raises(ValueError, match="policy_delay: expected at least 1"):
        TD3Config(policy_delay=0)
    with pytest.raises(ValueError, match="initial_temperature: expected more than 0"):
        SACConfig(initial_temperature=0.0)
