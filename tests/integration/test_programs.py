"""What a library's user writes: short programs of public names alone."""

import jax
import numpy as np
import pytest

import vertiwm_jax as vw

CONFIG = """
ground: {starts: 8, pairs: 2}
navigation: {horizon_seconds: 3, settle_steps: 2}
simulator: {substeps: 1}
action_repeat: 2
planning: null
ppo: {num_envs: 8, num_steps: 8, minibatches: 2, epochs: 1, hidden: [8], schedule: constant}
"""


def hill() -> vw.TerrainMap:
    x, y = np.meshgrid(np.arange(129) - 64.0, 64.0 - np.arange(129))
    return vw.TerrainMap.from_array(4 + 3 * np.exp(-(x**2 + y**2) / 400), "grass")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A policy, and its run folder."""
    folder = tmp_path_factory.mktemp("programs")
    (folder / "tiny.yaml").write_text(CONFIG)
    runs = folder / "runs"
    policy = vw.train(folder / "tiny.yaml", hill(), runs=runs, model="builtin", total_timesteps=256)
    (run,) = runs.iterdir()
    return policy, run


def test_a_policy_is_trained_and_tested_on_one_map(trained):
    policy, run = trained
    assert {path.name for path in (run / "policy").iterdir()} == {"policy.yaml", "weights.npz"}
    result = vw.evaluate(policy, hill(), pairs=2)
    assert result.ending.shape == (2,) and np.all(result.steps <= 30)
    with pytest.raises(ValueError, match=r"learning_rat: unknown setting.*'learning_rate'"):
        vw.train("ppo", hill(), learning_rat=1.0)


def test_a_trained_policy_drives(trained):
    policy, run = trained
    again = vw.load_policy(run)
    env, task = vw.make_env(hill(), config=again.task, pairs=2)
    observation, state = env.reset(jax.random.key(0), task)
    np.testing.assert_array_equal(again(observation), policy(observation))
    observation, state, reward, *_ = env.step(jax.random.key(1), state, again(observation), task)
    assert np.isfinite(reward) and np.isfinite(again.value(observation))
    alone = vw.load_policy(run / "policy")
    assert alone.config == policy.config
    with pytest.raises(ValueError, match="seed: expected 0 to 0, found 1"):
        vw.load_policy(run, seed=1)
