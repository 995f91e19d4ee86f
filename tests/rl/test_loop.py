import os
import signal

import chex
import jax
import jax.numpy as jnp
import pytest
from counting import Counting
from rl.probes import Broken, ProbeParams, Target

from vertiwm_jax import checkpoints, runs
from vertiwm_jax.rl.ppo import PPO, PPOConfig
from vertiwm_jax.runs import Run
from vertiwm_jax.training import (
    LoopConfig,
    Seeds,
    TrainingError,
    TrainingInterrupted,
    Work,
    restore,
    train,
)

CONFIG = PPOConfig(
    total_timesteps=6 * 32, num_envs=4, num_steps=8, minibatches=2, epochs=2, hidden=(8,)
)


@pytest.fixture
def new_run(tmp_path):
    return lambda: Run.create(tmp_path, "test", CONFIG)


def go(algorithm, run, iterations, env_params=ProbeParams(), **config):
    config = LoopConfig(**{"seeds": 2, "checkpoint_every": 4, **config})
    seeds = Seeds(algorithm, config.seeds)
    restored = restore(seeds, env_params, run.folder)
    work = Work("timesteps", 32 * config.seeds, ())
    return train(seeds, env_params, jax.random.key(0), run, iterations, work, config, restored)


def interrupt_at(monkeypatch, iteration):
    """A Ctrl-C while the metrics of `iteration` are written."""
    log = Run.log

    def stopping(self, step, metrics):
        log(self, step, metrics)
        if step == iteration:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Run, "log", stopping)


def test_resumed_training_ends_with_the_same_bits(new_run, monkeypatch):
    ppo = PPO(Target(), CONFIG)
    straight_run, stopped_run = new_run(), new_run()
    straight = go(ppo, straight_run, ppo.iterations)
    with monkeypatch.context() as patch:
        interrupt_at(patch, 3)
        with pytest.raises(TrainingInterrupted, match=r"iteration 3 of 6.*--resume"):
            go(ppo, stopped_run, ppo.iterations)
    resumed = go(ppo, Run(stopped_run.folder, CONFIG, 3), ppo.iterations)
    chex.assert_trees_all_equal(straight, resumed)

    def numbers(run):
        timed = ("wall_time", "timesteps_per_second")
        lines = runs.read_metrics(run.folder)
        return [{name: line[name] for name in line if name not in timed} for line in lines]

    assert numbers(stopped_run) == numbers(straight_run)
    assert len(numbers(stopped_run)) == 6


def test_metrics_checkpoints_and_the_finished_state(new_run, caplog):
    caplog.set_level("INFO", "vertiwm_jax")
    run = new_run()
    state = go(Counting(), run, 10, jnp.float32(1), keep=2)
    assert "compiling for 2 of 2 devices ..." in caplog.messages
    chex.assert_trees_all_equal(state.count, jnp.full(2, 11.0))
    lines = runs.read_metrics(run.folder)
    assert [line["count"] for line in lines] == list(range(1, 11))
    assert [line["timesteps"] for line in lines] == [64 * step for step in range(1, 11)]
    assert not any("never" in line or "finite" in line for line in lines)
    kept = sorted(path.name for path in (run.folder / "checkpoints").iterdir())
    assert kept == ["10", "8"]
    again = go(Counting(), run, 10, jnp.float32(1), keep=2)
    chex.assert_trees_all_equal(state, again)
    assert len(runs.read_metrics(run.folder)) == 10


def test_a_number_that_is_none_stops_with_the_last_good_checkpoint(new_run):
    run = new_run()
    with pytest.raises(TrainingError, match=r"iteration 6: .*checkpoints/4; try") as error:
        go(PPO(Broken(), CONFIG), run, 6)
    assert "\n" not in str(error.value)
    latest = checkpoints.latest(run.folder / "checkpoints")
    assert latest is not None and latest.name == "4"


def test_a_run_of_another_shape_cannot_be_resumed(new_run):
    run = new_run()
    go(Counting(), run, 2, jnp.float32(0))
    with pytest.raises(checkpoints.CheckpointError, match=r"count: expected float32\[3\]"):
        go(Counting(), run, 4, jnp.float32(0), seeds=3)


def test_settings_below_one_are_refused():
    with pytest.raises(ValueError, match="seeds: expected at least 1, found 0"):
        LoopConfig(seeds=0)
    with pytest.raises(ValueError, match="keep: expected at least 1, found 0"):
        LoopConfig(keep=0)
