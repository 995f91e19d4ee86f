import os
import signal
from dataclasses import dataclass, replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from vertiwm_jax import runs
from vertiwm_jax.checkpoints import CheckpointError
from vertiwm_jax.learning import fitting
from vertiwm_jax.learning.fitting import Fit, FitConfig, FitInputs
from vertiwm_jax.runs import Run
from vertiwm_jax.training import CheckpointConfig, TrainingError, TrainingInterrupted

CONFIG = FitConfig(
    updates=60,
    updates_per_iteration=10,
    learning_rate=0.1,
    warm_up=5,
    checkpoints=CheckpointConfig(checkpoint_every=4),
)
SLOPE = np.array([2.0, -1.0], np.float32)


@dataclass(frozen=True)
class Line:
    """Linear regression on rows of data; some batches may have no finite gradient."""

    lost: float = 0.0
    batch: int = 8

    @property
    def config(self):
        return self

    def loss(self, params, data, key):
        rows = jax.random.randint(key, (self.batch,), 0, len(data))
        spoilt = jax.random.uniform(jax.random.fold_in(key, 1)) < self.lost
        return squared_error(params, data[rows]) * jnp.where(spoilt, jnp.nan, 1.0)

    def validate(self, params, data):
        error = jnp.mean((data @ (params["slope"] - SLOPE) + params["offset"]) ** 2)
        return {"error": error, "never": jnp.nan}


def squared_error(params, x):
    return jnp.mean((x @ params["slope"] + params["offset"] - x @ SLOPE) ** 2)


@dataclass(frozen=True)
class Worse(Line):
    """The more it learns, the larger is its error on data held out."""

    def validate(self, params, data):
        return {"error": 10 + params["slope"][0]}


def data():
    return jax.random.normal(jax.random.key(5), (100, 2))


def params():
    return {"slope": np.zeros(2, np.float32), "offset": np.float32(0.5)}


@pytest.fixture
def new_run(tmp_path):
    return lambda: Run.create(tmp_path, "test", CONFIG)


def go(run, config=CONFIG, problem=Line()):
    return fitting.fit(problem, config, params(), data(), jax.random.key(0), run)


def numbers(run):
    timed = ("wall_time", "updates_per_second")
    return [
        {k: v for k, v in line.items() if k not in timed} for line in runs.read_metrics(run.folder)
    ]


def test_the_error_falls_and_the_result_is_saved(new_run):
    run = new_run()
    fitted = go(run)
    np.testing.assert_allclose(fitted["slope"], SLOPE, atol=0.1)
    lines = numbers(run)
    assert [line["updates"] for line in lines] == [10, 20, 30, 40, 50, 60]
    assert lines[-1]["loss"] < 0.05 * lines[0]["loss"]
    assert lines[-1]["best_error"] == min(line["error"] for line in lines)
    assert not any("never" in line or "finite" in line for line in lines)
    chex.assert_trees_all_equal(fitting.load(run.folder, jax.eval_shape(params)), fitted)
    chex.assert_trees_all_equal(go(run), fitted)  # done: nothing is done again
    assert fitting.load(new_run().folder, params()) is None


def test_a_fit_that_was_stopped_ends_with_the_same_bits(new_run, monkeypatch):
    straight_run, stopped_run = new_run(), new_run()
    straight = go(straight_run)
    log = Run.log

    def stopping(self, step, metrics):
        log(self, step, metrics)
        if step == 3:
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Run, "log", stopping)
        with pytest.raises(TrainingInterrupted, match="iteration 3 of 6"):
            go(stopped_run)
    assert fitting.load(stopped_run.folder, params()) is None
    resumed = go(Run(stopped_run.folder, CONFIG, 3))
    chex.assert_trees_all_equal(straight, resumed)
    assert numbers(stopped_run) == numbers(straight_run)


@pytest.mark.parametrize("batches", [1, 3])
def test_updates_are_those_of_adamw_by_hand(batches):
    fit = Fit(Line(), replace(CONFIG, grad_accumulation=batches))
    inputs, key = FitInputs(params(), data()), jax.random.key(0)
    state, _ = jax.jit(fit.iterate)(inputs, fit.init(inputs, key))
    rate = optax.warmup_cosine_decay_schedule(0.0, 0.1, 5, 60, 0.001)
    moments = {name: [np.zeros_like(p, np.float64)] * 2 for name, p in params().items()}
    weights = {name: np.float64(p) for name, p in params().items()}
    for step in range(10):
        now = jax.tree.map(jnp.float32, weights)
        keys = [jax.random.fold_in(key, batches * step + batch) for batch in range(batches)]
        rows = [jax.random.randint(key, (Line().batch,), 0, len(data())) for key in keys]
        gradient = jax.grad(squared_error)(now, data()[jnp.concatenate(rows)])
        norm = np.sqrt(sum(np.sum(np.float64(g) ** 2) for g in gradient.values()))
        for name, g in gradient.items():
            g = np.float64(g) * min(1, 1 / norm)
            first, second = moments[name]
            first, second = 0.9 * first + 0.1 * g, 0.99 * second + 0.01 * g**2
            moments[name] = [first, second]
            direction = first / (1 - 0.9 ** (step + 1))
            direction /= np.sqrt(second / (1 - 0.99 ** (step + 1))) + 1e-8
            weights[name] -= float(rate(step)) * (direction + 1e-4 * weights[name])
    chex.assert_trees_all_close(state.trained, jax.tree.map(np.float32, weights), atol=1e-5)


def test_only_what_is_trainable_changes(new_run):
    config = replace(CONFIG, trainable=("slope",))
    run = new_run()
    fitted = go(run, config)
    assert fitted["offset"] == params()["offset"]
    assert not np.allclose(fitted["slope"], 0)
    inputs = FitInputs(params(), data())
    state = Fit(Line(), config).init(inputs, jax.random.key(0))
    assert state.trained["offset"] is None


def test_the_parameters_with_the_lowest_error_are_kept(new_run):
    run = new_run()
    fitted = go(run, problem=Worse())
    lines = numbers(run)
    assert lines[0]["error"] < lines[-1]["error"]
    assert float(fitted["slope"][0]) == pytest.approx(lines[0]["error"] - 10, abs=1e-5)


def test_a_gradient_that_is_not_finite_is_skipped(new_run):
    run = new_run()
    fitted = go(run, problem=Line(lost=0.03))
    skipped = [line["skipped"] for line in numbers(run)]
    assert 0 < max(skipped) < 0.11
    np.testing.assert_allclose(fitted["slope"], SLOPE, atol=0.1)
    assert all(np.isfinite(line["loss"]) for line in numbers(run))


def test_gradients_that_are_never_finite_end_in_one_clear_error(new_run):
    with pytest.raises(TrainingError, match="iteration 1: loss or weights are no longer") as error:
        go(new_run(), problem=Line(lost=1.0))
    assert "\n" not in str(error.value)


def test_a_run_of_other_parameters_cannot_be_continued(new_run):
    run = new_run()
    go(run)
    config = replace(CONFIG, trainable=("slope",))
    with pytest.raises(CheckpointError, match="offset"):
        go(run, config)


def test_entries_within_entries_can_be_trained_alone():
    nested = {"gate": {"network": np.ones(2), "networks": np.ones(2)}, "other": np.ones(1)}
    config = replace(CONFIG, trainable=("gate.network",))
    state = Fit(Line(), config).init(FitInputs(nested, data()), jax.random.key(0))
    assert state.trained["gate"]["networks"] is None
    assert state.trained["other"] is None
    np.testing.assert_array_equal(state.trained["gate"]["network"], [1, 1])


def test_entries_that_do_not_exist_cannot_be_trained(new_run):
    config = replace(CONFIG, trainable=("slop",))
    with pytest.raises(ValueError, match=r"trainable: .* offset, slope, or .*; found 'slop'"):
        go(new_run(), config)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"updates": -10}, "updates: expected at least 0, found -10"),
        ({"updates": 65}, "updates: expected a multiple of updates_per_iteration, 10, found 65"),
        ({"grad_accumulation": 0}, "grad_accumulation: expected at least 1, found 0"),
        ({"warm_up": 60}, "warm_up: expected 0 to 59 updates, found 60"),
        ({"learning_rate": 0.0}, "learning_rate: expected more than 0"),
        ({"max_gradient_norm": 0.0}, "max_gradient_norm: expected more than 0"),
    ],
)
def test_settings_out_of_range_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **change)
