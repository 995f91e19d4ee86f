"""The model that comes with the package, on drives of the repository's own test split."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.evaluation import prediction
from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.learning import dataset
from vertiwm_jax.models.registry import load_model

MIXED = Path(__file__).parents[2] / "data" / "open" / "mixed"


@pytest.fixture(scope="module")
def windows():
    drives, terrain = dataset.load_drives(MIXED, "test")
    return TestWindows.of(drives, terrain, context=16, horizon=16, stride=32)


RECORDED = {"rigid": 0.0534, "deformable": 0.0918, "transition": 0.1121}
"""Position errors of Verti-WM after 16 steps, m."""


@pytest.mark.integration
@pytest.mark.smoke
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_it_predicts_as_it_always_did(windows, dtype):
    """So that what is changed for speed leaves predictions what they are, to rounding."""
    model, params = load_model("vertiwm", compute_dtype=dtype)
    states = prediction.predict(model, params, windows).states
    errors = prediction.summary("it", states, windows)
    found = {kind: interval.mean for kind, interval in errors.final["position"].items()}
    assert found == pytest.approx(RECORDED, rel=0.01)


def mean_error(name, windows):
    errors, lost = prediction.absolute_errors(
        prediction.predict(*load_model(name), windows).states, windows
    )
    assert not lost.any(), name
    return errors["position"][:, -1].mean()


@pytest.mark.integration
def test_it_predicts_better_than_what_it_is_made_of(windows):
    error = {name: mean_error(name, windows) for name in ("vertiwm", "nesam", "builtin")}
    assert error["nesam"] < 0.7 * error["builtin"]
    assert error["vertiwm"] < 1.02 * error["nesam"]
    assert error["vertiwm"] < 0.2


def test_its_weights_are_finite_and_few():
    _, params = load_model("vertiwm")
    assert sum(x.size for x in jax.tree.leaves(params.gate.network)) == 4 * 33_764
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(params))
    assert {x.dtype for x in jax.tree.leaves(params)} == {jnp.dtype("float32")}
    assert sum(x.size for x in jax.tree.leaves(params)) * 4 < 10e6
