import jax
import jax.numpy as jnp
import numpy as np
from world_model.examples import driving, one, rough

from vertiwm_jax.networks.encoder import TerrainEncoder
from vertiwm_jax.terrain import patches
from vertiwm_jax.world_model.perception import Exteroception, Perception

TERRAIN, STATE = rough(), driving()
FROZEN = Exteroception()
PARAMS = jax.jit(FROZEN.init_params)(jax.random.key(0))
PARAMS = jax.tree.map(lambda x: x + 0.03 * jnp.cos(jnp.arange(x.size)).reshape(x.shape), PARAMS)


def test_average_is_over_space_elevation_first():
    elevation, semantic = np.random.default_rng(0).normal(size=(2, 5, 16, 16, 18))
    averaged = Perception(jnp.asarray(elevation), jnp.asarray(semantic)).averaged
    assert averaged.shape == (5, 36)
    expected = np.concatenate([elevation.mean((1, 2)), semantic.mean((1, 2))], axis=-1)
    np.testing.assert_allclose(averaged, expected, atol=1e-6)


def test_perceives_what_its_encoders_make_of_the_patches_at_the_pose():
    seen = FROZEN.encode(PARAMS, FROZEN.query(TERRAIN, STATE))
    drawn = patches.query(TERRAIN, STATE.position, STATE.rpy[2])
    elevation = TerrainEncoder(1).apply(PARAMS.elevation, drawn.elevation[..., None])
    semantic = TerrainEncoder(3).apply(PARAMS.semantic, drawn.rgb)
    assert seen.elevation.shape == seen.semantic.shape == (16, 16, 18)
    np.testing.assert_allclose(seen.elevation, elevation, atol=1e-5)
    np.testing.assert_allclose(seen.semantic, semantic, atol=1e-5)


def test_no_gradient_flows_to_the_pose():
    def total(state):
        return jnp.sum(FROZEN.encode(PARAMS, FROZEN.query(TERRAIN, state)).latent ** 2)

    gradient = jax.jit(jax.grad(total))(STATE)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(gradient))


def test_encoders_do_not_learn():
    drawn = FROZEN.query(TERRAIN, STATE)
    loss = jax.jit(lambda p: jnp.sum(FROZEN.encode(p, drawn).latent ** 2))
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(jax.grad(loss)(PARAMS)))


def test_a_batch_is_a_loop():
    states = driving(3, 4)
    look = jax.jit(lambda s: FROZEN.encode(PARAMS, FROZEN.query(TERRAIN, s)))
    together = jax.vmap(look)(states)
    for i in range(4):
        alone = look(one(states, i))
        np.testing.assert_allclose(together.latent[i], alone.latent, atol=1e-4)
