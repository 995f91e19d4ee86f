import subprocess
import sys

import gymnax
import jax
import numpy as np
import pytest
from env.worlds import ground, hills

from vertiwm_jax.checkpoints import CheckpointError
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.gym import GYMNAX_NAME
from vertiwm_jax.terrain import map as terrain_map

STEPS = 6


@pytest.fixture(scope="module")
def made():
    """Episodes of 3 steps on two worlds."""
    terrain = terrain_map.stack([ground(hills()), ground(hills(height=0.5))])
    config = NavigationConfig(horizon_seconds=0.3)
    return gymnax.make(GYMNAX_NAME, terrain=terrain, model="bicycle", pairs=5, config=config)


def test_it_is_made_by_name():
    assert GYMNAX_NAME in gymnax.registered_envs


@pytest.mark.integration
def test_random_rollouts_in_gymnax_s_own_way(made):
    env, env_params = made

    def rollout(key):
        key_reset, key_steps = jax.random.split(key)
        observation, state = env.reset(key_reset, env_params)

        def step(carry, key):
            _, state = carry
            key_action, key_step = jax.random.split(key)
            action = env.action_space(env_params).sample(key_action)
            observation, state, *result = env.step(key_step, state, action, env_params)
            return (observation, state), (observation, *result)

        keys = jax.random.split(key_steps, STEPS)
        return jax.lax.scan(step, (observation, state), keys)[1]

    seen, reward, terminated, truncated, info = jax.jit(jax.vmap(rollout))(
        jax.random.split(jax.random.key(0), 4)
    )
    assert seen.shape == (4, STEPS, *env.observation_space(env_params).shape)
    assert np.isfinite(seen).all() and np.isfinite(reward).all()
    assert not terminated.any()
    # Episodes are over after three steps, and begin anew.
    np.testing.assert_array_equal(truncated, [[i % 3 == 2 for i in range(STEPS)]] * 4)
    assert (info["ending"][:, 2] == TerminationReason.TIMED_OUT).all()
    assert len(np.unique(info["distance"][:, 2])) > 1


def test_settings_decide_worlds_and_tasks(made):
    env, env_params = made
    assert env_params.terrain.worlds == 2 and env_params.pool_size == 10
    assert env.default_params is env_params
    other, params = gymnax.make(GYMNAX_NAME, terrain=ground(), model="bicycle", pairs=1)
    assert other != env and params.terrain.worlds == params.pool_size == 1


def test_a_model_that_does_not_exist_is_refused():
    with pytest.raises(CheckpointError, match="expected unicycle, found"):
        gymnax.make(GYMNAX_NAME, model="unicycle")


IMPORT = """
import sys
import vertiwm_jax.rl.experiment
drawing = {"seaborn", "pandas", "matplotlib.pyplot"}
assert not drawing & set(sys.modules), drawing & set(sys.modules)
from gymnax.environments.misc import pong
assert len(pong.sns.color_palette()) and pong.plt.figure is sys.modules["matplotlib.pyplot"].figure
assert drawing <= set(sys.modules)
import seaborn
assert seaborn.__spec__ is not None
"""


def test_what_gymnax_draws_with_is_imported_when_it_draws():
    subprocess.run([sys.executable, "-c", IMPORT], check=True)
