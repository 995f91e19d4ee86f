"""Forms of a model that only drives."""

from dataclasses import replace
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from world_model.examples import commands, driving, one, rough

from vertiwm_jax.dynamics import embedding, rollout
from vertiwm_jax.world_model.choice import choose, lean, rounded
from vertiwm_jax.world_model.model import ModelConfig
from vertiwm_jax.world_model.transformer_specialist import TransformerSpecialist

TERRAIN, STATES, COMMANDS = rough(), driving(3, 5), commands(8)


@partial(jax.jit, static_argnames="model")
def drive(model, params, states):
    def of_one(state):
        history = model.init(params, TERRAIN, state)
        return rollout(model, params, TERRAIN, state, COMMANDS, history)

    return jax.vmap(of_one)(states)


def drives_alike(model, params):
    assert lean(model) != model and lean(lean(model)) == lean(model)
    expected, found = (drive(m, params, STATES) for m in (model, lean(model)))
    np.testing.assert_allclose(found.vector, expected.vector, atol=1e-3)


@pytest.mark.parametrize("name", ["vertiwm", "transformer", "nesam"])
def test_a_lean_model_drives_alike(name):
    drives_alike(*choose(name))


def filled(leaf):
    return leaf if leaf.any() else jax.random.normal(jax.random.key(1), leaf.shape) / 50


@pytest.mark.parametrize("soil", ["map", "predicted"])
def test_so_does_one_whose_specialists_have_encoders_of_their_own(soil):
    config = ModelConfig(soil=soil)
    untrained = config.init_params(jax.random.key(0), choose("builtin")[1])
    # Where nothing is learned yet, the ground is not read at all.
    drives_alike(config.build(), jax.tree.map(filled, untrained))


@pytest.mark.parametrize("name", ["builtin", "bicycle"])
def test_models_without_latents_are_lean_already(name):
    model, _ = choose(name)
    assert lean(model) == model


def test_nesam_needs_latents_for_soils():
    config = ModelConfig(encoders="shared", soil="predicted")
    assert lean(config.build()) == config.build()
    with pytest.raises(ValueError, match="remembers: expected latents"):
        replace(config.build(), transformer=lean(config.transformer))
    with pytest.raises(ValueError, match="remembers: expected latents to predict soils"):
        replace(config.nesam, remembers="glance")


def test_what_needs_latents_is_refused():
    with pytest.raises(ValueError, match="remembers: expected latents"):
        TransformerSpecialist(terrain="none", remembers="glance")
    model, params = choose("transformer")
    with pytest.raises(ValueError, match="embeddings: expected a model that sees"):
        embedding(jax.eval_shape(lean(model).init, params, TERRAIN, one(STATES, 0)))


def away(model, params, network, commands):
    params, state = replace(params, network=network), one(STATES, 0)
    history = model.init(params, TERRAIN, state)
    return jnp.sum(rollout(model, params, TERRAIN, state, commands, history).position[-1])


by_commands = jax.jit(jax.grad(away, argnums=3), static_argnums=0)


def test_a_lean_model_moves_by_its_commands_but_does_not_learn():
    model, params = choose("transformer")
    expected, found = (
        by_commands(m, params, params.network, COMMANDS) for m in (model, lean(model))
    )
    np.testing.assert_allclose(found.vector, expected.vector, atol=1e-4)
    assert np.any(expected.vector)
    with pytest.raises(TypeError, match="remembers: expected latents to learn"):
        jax.grad(away, argnums=2)(lean(model), params, params.network, COMMANDS)


@pytest.mark.parametrize("name", ["vertiwm", "transformer", "nesam"])
def test_rounded_operands_are_those_of_the_transformers_alone(name):
    model, params = choose(name)
    half = rounded(params, "bfloat16")
    small = {
        jax.tree_util.keystr(path)
        for path, leaf in jax.tree_util.tree_leaves_with_path(half)
        if leaf.dtype == jnp.bfloat16
    }
    # Of each network, four matrices in each of three layers, and what embeds the ground in one.
    assert len(small) == {"vertiwm": 25, "transformer": 13, "nesam": 12}[name]
    assert all("network" in leaf and "kernel" in leaf for leaf in small)
    expected, found = drive(model, params, STATES), drive(model, half, STATES)
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {jnp.dtype("float32")}
    assert not np.array_equal(found.vector, expected.vector)
    np.testing.assert_allclose(found.position, expected.position, atol=0.01)
    chex.assert_trees_all_equal(rounded(params, "float32"), params)


def test_commands_move_what_has_rounded_operands():
    """As planners by gradients need it."""
    model, params = choose("transformer")
    expected, found = (
        by_commands(model, p, p.network, COMMANDS) for p in (params, rounded(params, "bfloat16"))
    )
    apart = np.linalg.norm(found.vector - expected.vector)
    assert 0 < apart < 0.05 * np.linalg.norm(expected.vector)
