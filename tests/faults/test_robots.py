"""A policy on a robot never commands what is no number, whatever runs it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest
from doors import exportable

from vertiwm_jax.deploy import description, onnx_graph, run_policy, stablehlo
from vertiwm_jax.env.observation import ARCS, OBSERVATION_SIZE
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.networks.policy import Actor, ObservationLayout
from vertiwm_jax.rl.policy import DeterministicPolicy
from vertiwm_jax.rl.running_statistics import RunningStatistics

STANDING = (-1.0, 0.0)


@pytest.fixture(scope="module")
def policy():
    actor = Actor(2, (8,), -0.5, ObservationLayout(ARCS))
    weights = actor.init(jax.random.key(0), jnp.zeros(OBSERVATION_SIZE))
    mean, variance = jnp.zeros(OBSERVATION_SIZE), jnp.ones(OBSERVATION_SIZE)
    learned = DeterministicPolicy(actor, weights, RunningStatistics(mean, variance, jnp.float32(9)))
    return exportable(learned, "look ahead", NavigationConfig())


@pytest.fixture(scope="module", params=["onnx", "stablehlo"])
def act(request, policy):
    """Observations to actions, as a robot computes them."""
    if request.param == "stablehlo":
        made = stablehlo.policy(policy, OBSERVATION_SIZE, STANDING)
        return jax.export.deserialize(bytearray(made)).call
    about, weights = description.about(policy), description.weights(policy)
    made = onnx_graph.record(partial(run_policy.act, about, weights), OBSERVATION_SIZE, 2)
    session = onnxruntime.InferenceSession(made, providers=["CPUExecutionProvider"])
    return lambda seen: session.run(["action"], {"observation": seen})[0]


def observations(value=None):
    """A good one, again for each of its numbers, which is then replaced by the value."""
    good = np.random.default_rng(0).normal(0, 0.5, OBSERVATION_SIZE).astype(np.float32)
    seen = np.tile(good, (1 + OBSERVATION_SIZE, 1))
    if value is not None:
        np.fill_diagonal(seen[1:], value)
    return seen


@pytest.mark.parametrize("value", [np.nan, -np.inf, np.inf])
def test_what_is_no_number_is_not_commanded(act, value):
    expected, actions = np.asarray(act(observations())), np.asarray(act(observations(value)))
    if not np.abs(expected).max() <= 1:
        raise RuntimeError("good observations are not acted on")
    np.testing.assert_allclose(actions[0], expected[0], atol=1e-6)
    np.testing.assert_array_equal(actions[1:], [STANDING] * OBSERVATION_SIZE)
