"""Models by name, in the forms that drive, plan and are seen by."""

from dataclasses import replace
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from world_model.examples import commands, driving, one, rough

from vertiwm_jax.checkpoints import CheckpointError
from vertiwm_jax.dynamics import embedding, rollout
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import load, load_vehicle
from vertiwm_jax.models import files
from vertiwm_jax.models.config import ModelConfig, with_soil
from vertiwm_jax.models.registry import load_encoders, load_fitted, load_model, moves_any
from vertiwm_jax.networks.specialist import cast_weights
from vertiwm_jax.world_model.nesam import Nesam

KEY = jax.random.key(0)
TERRAIN, STATES, COMMANDS = rough(), driving(3, 5), commands(8)
LEARNED = ("vertiwm", "transformer", "nesam")


@partial(jax.jit, static_argnames="model")
def drive(model, params, states):
    def of_one(state):
        history = model.init(params, TERRAIN, state)
        return rollout(model, params, TERRAIN, state, COMMANDS, history)

    return jax.vmap(of_one)(states)


@pytest.mark.parametrize("name", ["vertiwm", "transformer"])
@pytest.mark.integration
def test_a_model_that_keeps_latents_drives_alike(name):
    expected, found = (drive(*load_model(name, embeddings=kept), STATES) for kept in (False, True))
    np.testing.assert_allclose(found.vector, expected.vector, atol=1e-3)


@pytest.mark.integration
def test_a_model_moves_the_vehicle_that_it_was_saved_with(tmp_path):
    """Of any layout, whose leaves those of the HMMWV do not have."""
    driven = replace(load("rover"), drive="rear", locked="rear", wheel_radius=(0.05, 0.06)).vehicle
    config = ModelConfig(parts=("nesam",), terrain="none")
    params = config.init_params(KEY, chrono_like(driven))
    files.save(tmp_path, config, params)
    found = files.load(tmp_path)[1].vehicle
    chex.assert_trees_all_equal(jax.device_get(found), driven)


@pytest.mark.parametrize("vehicles", ["one", "any"])
def test_a_model_of_any_vehicle_moves_the_one_that_is_asked_for(tmp_path, vehicles):
    rover = load("rover").vehicle
    config = ModelConfig(parts=("nesam",), terrain="none", vehicles=vehicles)
    files.save(tmp_path, config, config.init_params(KEY, chrono_like(load_vehicle())))
    _, own = load_model("nesam", tmp_path)
    _, asked = load_model("nesam", tmp_path, vehicle=rover)
    chex.assert_trees_all_equal(own.vehicle, load_vehicle())
    chex.assert_trees_all_equal(asked.vehicle, rover if vehicles == "any" else load_vehicle())


def test_every_vehicle_but_the_hmmwv_has_the_shipped_model_of_any():
    hmmwv, rover, husky = (load(name).vehicle for name in ("hmmwv", "rover", "husky"))
    for asked, any_vehicle in ((None, False), (hmmwv, False), (rover, True)):
        model, params = load_model("nesam", vehicle=asked)
        assert moves_any(model) == any_vehicle
        chex.assert_trees_all_equal(params.vehicle, asked or hmmwv)
    model, params = load_model("nesam", "any_vehicle")
    assert moves_any(model) and params.vehicle.mass == hmmwv.mass
    chex.assert_trees_all_equal(load_encoders("any_vehicle"), load_encoders())
    with pytest.raises(CheckpointError, match="whose front wheels steer, found one that is skid"):
        load_model("nesam", vehicle=husky)


def test_embeddings_are_kept_where_they_are_asked_for():
    def seen(name, **asked):
        model, params = load_model(name, **asked)
        return embedding(jax.eval_shape(model.init, params, TERRAIN, one(STATES, 0)))

    assert seen("vertiwm", embeddings=True).shape == (16, 16, 36)
    assert seen("transformer", embeddings=True).shape == (16, 16, 36)
    for name in (*LEARNED, "builtin", "bicycle"):
        assert seen(name) is None
    assert seen("nesam", embeddings=True) is None


@pytest.mark.parametrize("name", LEARNED)
@pytest.mark.integration
def test_matrices_are_those_of_the_transformers_alone(name):
    (model, params), (_, half) = (
        load_model(name, compute_dtype=dtype) for dtype in ("float32", "bfloat16")
    )
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
    chex.assert_trees_all_equal(cast_weights(params, "float32"), params)


@pytest.mark.integration
def test_commands_move_what_has_rounded_matrices():
    """As planners by gradients need it."""

    def away(model, params, commands):
        state = one(STATES, 0)
        history = model.init(params, TERRAIN, state)
        return jnp.sum(rollout(model, params, TERRAIN, state, commands, history).position[-1])

    by_commands = jax.jit(jax.grad(away, argnums=2), static_argnums=0)
    expected, found = (
        by_commands(*load_model("transformer", compute_dtype=dtype), COMMANDS)
        for dtype in ("float32", "bfloat16")
    )
    apart = np.linalg.norm(found.vector - expected.vector)
    assert 0 < apart < 0.05 * np.linalg.norm(expected.vector)


def test_gradients_through_physics_are_exact_where_they_are_asked_for():
    fused, alone = (load_model(name, exact_gradient=True)[0] for name in ("vertiwm", "nesam"))
    for nesam in (fused.nesam, alone.specialist):
        assert isinstance(nesam, Nesam) and nesam.gradient == "exact"
    assert load_model("vertiwm")[0].nesam.gradient == "mean"


def test_soils_are_predicted_where_they_are_asked_for():
    for name in ("vertiwm", "nesam"):
        predicted, of_map = (load_model(name, soil=soil)[1] for soil in ("predicted", "map"))
        assert predicted.encoders[-1].soil is not None
        assert not of_map.encoders or of_map.encoders[-1].soil is None


def filled(leaf):
    return leaf if leaf.any() else jax.random.normal(jax.random.key(1), leaf.shape) / 50


@pytest.mark.parametrize("encoders", ["own", "shared"])
@pytest.mark.parametrize("terrain", ["patches", "indicator"])
@pytest.mark.integration
def test_what_was_saved_is_loaded_by_its_parts(tmp_path, encoders, terrain):
    parts = ("transformer", "nesam") if terrain != "patches" else ("transformer", "nesam", "gate")
    config = ModelConfig(parts, terrain=terrain, encoders=encoders)
    params = config.init_params(KEY, load_model("builtin")[1])
    files.save(tmp_path, config, params)
    found, loaded = files.load(tmp_path)
    assert found == config
    chex.assert_trees_all_equal(loaded, jax.tree.map(jnp.asarray, params))
    fitted = load_fitted(tmp_path)
    assert set(fitted) == {"transformer", "nesam"} | ({"vertiwm"} if "gate" in parts else set())
    if "gate" in parts:
        whole = jax.tree.map(filled, with_soil(params, None))
        drives = drive(config.verti_wm, whole, STATES)
        assert np.isfinite(drives.vector).all()
    else:
        with pytest.raises(CheckpointError, match="expected vertiwm, found nesam and transformer"):
            load_model("vertiwm", tmp_path)
