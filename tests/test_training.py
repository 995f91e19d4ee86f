"""The host loop without seeds; `tests/rl/test_loop.py` trains real algorithms in it."""

import os
import signal
from dataclasses import dataclass
from typing import ClassVar

import chex
import jax
import jax.numpy as jnp
import pytest
from counting import Counter, Counting

from vertiwm_jax import checkpoints, runs, training
from vertiwm_jax.runs import Run
from vertiwm_jax.training import (
    CheckpointConfig,
    TrainingError,
    TrainingInterrupted,
    Work,
)

CONFIG = CheckpointConfig(checkpoint_every=4, keep=2)


@pytest.fixture
def new_run(tmp_path):
    return lambda: Run.create(tmp_path, "test", CONFIG)


def go(run, iterations, start=1.0):
    algorithm, data = Counting(), jnp.float32(start)
    restored = training.restore(algorithm, data, run.folder)
    work = Work("pages", 5, ("count",))
    return training.train(
        algorithm, data, jax.random.key(0), run, iterations, work, CONFIG, restored
    )


def interrupt_at(monkeypatch, iteration, times, number=signal.SIGINT):
    """Ctrl-C, or another signal, once or more, while the metrics of `iteration` are written."""
    log = Run.log

    def stopping(self, step, metrics):
        log(self, step, metrics)
        if step == iteration:
            for _ in range(times):
                os.kill(os.getpid(), number)

    monkeypatch.setattr(Run, "log", stopping)


def test_metrics_checkpoints_progress_and_the_finished_state(new_run, capsys, caplog):
    caplog.set_level("INFO", "vertiwm_jax")
    run = new_run()
    state = go(run, 10)
    out = capsys.readouterr().out
    assert "compiling for 1 of 2 devices ..." in caplog.messages
    assert "training 50/50" in out and "count 10" in out
    chex.assert_trees_all_equal(state, Counter(jnp.float32(11)))
    lines = runs.read_metrics(run.folder)
    assert [line["count"] for line in lines] == list(range(1, 11))
    assert [line["pages"] for line in lines] == [5 * step for step in range(1, 11)]
    assert all(line["pages_per_second"] > 0 for line in lines)
    assert not any("never" in line or "finite" in line for line in lines)
    kept = sorted(path.name for path in (run.folder / "checkpoints").iterdir())
    assert kept == ["10", "8"]
    chex.assert_trees_all_equal(go(run, 10), state)
    assert len(runs.read_metrics(run.folder)) == 10


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_interrupt_ends_the_iteration_and_saves(new_run, monkeypatch, number):
    before = signal.getsignal(number)
    run = new_run()
    with monkeypatch.context() as patch:
        interrupt_at(patch, 6, times=1, number=number)
        with pytest.raises(TrainingInterrupted, match=r"iteration 6 of 10, all saved; .*--resume"):
            go(run, 10)
    assert signal.getsignal(number) is before
    chex.assert_trees_all_equal(go(Run(run.folder, CONFIG, 6), 10), Counter(jnp.float32(11)))
    assert [line["step"] for line in runs.read_metrics(run.folder)] == list(range(1, 11))


def test_the_second_interrupt_stops_at_once(new_run, monkeypatch):
    run = new_run()
    interrupt_at(monkeypatch, 6, times=2)
    with pytest.raises(KeyboardInterrupt):
        go(run, 10)
    latest = checkpoints.latest(run.folder / "checkpoints")
    assert latest is not None and latest.name == "4"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_what_is_not_finite_ends_the_training_with_the_last_good_checkpoint(new_run):
    with pytest.raises(TrainingError, match=r"iteration 6: .*checkpoints/4; try") as error:
        go(new_run(), 10, start=1e6 - 5)
    assert "\n" not in str(error.value)


def test_settings_below_one_are_refused():
    with pytest.raises(ValueError, match="keep: expected at least 1, found 0"):
        CheckpointConfig(keep=0)


def test_what_comes_again_is_not_compiled_again(new_run):
    @dataclass(frozen=True)
    class Traced(Counting):
        traces: ClassVar[list[int]] = []

        def iterate(self, data, state):
            self.traces.append(1)
            return super().iterate(data, state)

    for start in (1.0, 5.0):
        data, work = jnp.float32(start), Work("pages", 5, ("count",))
        state = training.train(Traced(), data, jax.random.key(0), new_run(), 3, work, CONFIG)
        chex.assert_trees_all_equal(state, Counter(jnp.float32(start + 3)))
    assert len(Traced.traces) == 1
