from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax import runs
from vertiwm_jax.learning import stages
from vertiwm_jax.learning.fitting import FitConfig
from vertiwm_jax.learning.stages import Inputs
from vertiwm_jax.runs import Run
from vertiwm_jax.training import CheckpointConfig

CONFIG = FitConfig(updates=20, updates_per_iteration=10, learning_rate=0.1, warm_up=5)


@dataclass(frozen=True)
class Pull:
    """Draws a number to a target."""

    target: float = 3.0
    batch: int = 1

    @property
    def config(self):
        return self

    def loss(self, params, data, key):
        return (params - self.target) ** 2

    def validate(self, params, data):
        return {"error": jnp.abs(params - self.target)}


INPUTS = Inputs(Pull(), CONFIG, (0, 1), ("rigid",), (("a.npz", 10, 1), ("b.npz", 20, 2)))


@pytest.fixture
def new_run(tmp_path):
    def new(name="one"):
        return Run.create(tmp_path / name, "test", CONFIG)

    return new


def go(run, inputs=INPUTS, reuse=()):
    """The result, and whether it was fitted."""
    asked = []

    def data():
        asked.append(True)
        return None

    found = stages.fit(run, "stage", inputs, np.float32(0), data, jax.random.key(0), reuse)
    return float(found), bool(asked)


def test_a_stage_that_has_ended_is_not_repeated(new_run):
    run = new_run()
    first, fitted = go(run)
    assert fitted and first > 1
    assert go(run) == (first, False)
    assert len(runs.read_metrics(run.folder / "stage")) == 2
    # Checkpoints change no result.
    rarer = replace(CONFIG, checkpoints=CheckpointConfig(checkpoint_every=50))
    assert go(run, replace(INPUTS, config=rarer)) == (first, False)


@pytest.mark.parametrize(
    "change",
    [
        {"problem": Pull(-2.0)},
        {"config": replace(CONFIG, learning_rate=0.05)},
        {"seed": (0, 2)},
        {"learns_from": ("rigid", "mixed")},
        {"drives": (("a.npz", 10), ("b.npz", 21))},
        {"before": ("another stage",)},
    ],
)
def test_a_stage_whose_inputs_have_changed_begins_anew(new_run, change, caplog):
    caplog.set_level("INFO")
    run = new_run()
    go(run)
    other = replace(INPUTS, **change)
    found, fitted = go(run, other)
    assert fitted and "its inputs have changed" in caplog.text
    assert go(run, other) == (found, False)
    assert other.digest != INPUTS.digest


def test_a_stage_is_taken_over_from_another_run_if_it_is_the_same(new_run, caplog):
    caplog.set_level("INFO")
    one, two = new_run("one"), new_run("two")
    first, _ = go(one)
    assert go(two, reuse=[new_run("empty").folder, one.folder]) == (first, False)
    assert f"stage: from {one.folder}" in caplog.text
    assert runs.read_metrics(two.folder / "stage") == runs.read_metrics(one.folder / "stage")
    _, fitted = go(new_run("three"), replace(INPUTS, problem=Pull(1.0)), [one.folder])
    assert fitted
