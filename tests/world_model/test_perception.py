import jax
import jax.numpy as jnp
import numpy as np
import pytest
from world_model.examples import driving, one, rough

from vertiwm_jax.networks.encoder import TerrainEncoder
from vertiwm_jax.terrain import crop
from vertiwm_jax.terrain.crop import PatchConfig
from vertiwm_jax.world_model.perception import Exteroception, Perception

TERRAIN, STATE = rough(), driving()
FROZEN, TUNED = Exteroception(), Exteroception(tune_encoders=True)
PARAMS = jax.jit(FROZEN.init_params)(jax.random.key(0))
PARAMS = jax.tree.map(lambda x: x + 0.03 * jnp.cos(jnp.arange(x.size)).reshape(x.shape), PARAMS)


def test_average_is_over_space_elevation_first():
    elevation, semantic = np.random.default_rng(0).normal(size=(2, 5, 16, 16, 18))
    averaged = Perception(jnp.asarray(elevation), jnp.asarray(semantic)).averaged
    assert averaged.shape == (5, 36)
    expected = np.concatenate([elevation.mean((1, 2)), semantic.mean((1, 2))], axis=-1)
    np.testing.assert_allclose(averaged, expected, atol=1e-6)


@pytest.mark.parametrize("config", [PatchConfig(), PatchConfig("vehicle", "bilinear")])
def test_perceives_what_its_encoders_make_of_the_patches_at_the_pose(config):
    sense = Exteroception(config)
    seen = sense.encode(PARAMS, sense.query(TERRAIN, STATE))
    patches = crop.patches(TERRAIN, STATE.position, STATE.rpy[2], config)
    elevation = TerrainEncoder(1).apply(PARAMS.elevation, patches.elevation[..., None])
    semantic = TerrainEncoder(3).apply(PARAMS.semantic, patches.rgb)
    assert seen.elevation.shape == seen.semantic.shape == (16, 16, 18)
    np.testing.assert_allclose(seen.elevation, elevation, atol=1e-5)
    np.testing.assert_allclose(seen.semantic, semantic, atol=1e-5)


def test_no_gradient_flows_to_the_pose():
    def total(state):
        return jnp.sum(TUNED.encode(PARAMS, TUNED.query(TERRAIN, state)).latent ** 2)

    gradient = jax.jit(jax.grad(total))(STATE)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("sense", [FROZEN, TUNED])
def test_encoders_learn_only_when_they_are_tuned(sense):
    patches = sense.query(TERRAIN, STATE)
    loss = jax.jit(lambda p: jnp.sum(sense.encode(p, patches).latent ** 2))
    gradient = jax.grad(loss)(PARAMS)
    learns = [bool(np.any(leaf)) for leaf in jax.tree.leaves(gradient)]
    assert all(learns) if sense.tune_encoders else not any(learns)


def test_a_batch_is_a_loop():
    states = driving(3, 4)
    look = jax.jit(lambda s: FROZEN.encode(PARAMS, FROZEN.query(TERRAIN, s)))
    together = jax.vmap(look)(states)
    for i in range(4):
        alone = look(one(states, i))
        np.testing.assert_allclose(together.latent[i], alone.latent, atol=1e-4)
