import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.fft
import scipy.ndimage

from vertiwm_jax.networks.encoder import TerrainAutoencoder, TerrainDecoder, TerrainEncoder

KEY = jax.random.key(0)
CHANNELS = (1, 3)


def encode(model, params, patches):
    own = {"params": params["params"]["encoder"]}
    return TerrainEncoder(model.channels).apply(own, patches)


def moved(params):
    """Away from the first values, so that no weight is zero."""
    return jax.tree.map(lambda x: x + 0.1 * jnp.cos(jnp.arange(x.size)).reshape(x.shape), params)


def patch(channels: int, *batch: int) -> jax.Array:
    return jax.random.uniform(jax.random.key(1), (*batch, 128, 128, channels), minval=-1, maxval=1)


def count(params) -> int:
    return sum(x.size for x in jax.tree.leaves(params))


def test_parameters_are_within_3_percent_of_the_paper():
    encoders = sum(count(TerrainEncoder(c).init(KEY, patch(c))) for c in CHANNELS)
    whole = sum(count(TerrainAutoencoder(c).init(KEY, patch(c))) for c in CHANNELS)
    assert encoders == 21_586 and abs(encoders / 21_514 - 1) < 0.03
    assert whole == 54_386 and abs(whole / 54_646 - 1) < 0.03


@pytest.mark.parametrize("channels", CHANNELS)
def test_an_encoder_pass_stays_below_6_mflop(channels):
    encoder = TerrainEncoder(channels)
    params = encoder.init(KEY, patch(channels))
    compiled = jax.jit(encoder.apply).lower(params, patch(channels)).compile()
    assert compiled.cost_analysis()["flops"] < 6e6
    # By hand, two for a multiplication and an addition, on 16 x 16 and on 8 x 8 cells.
    fine, coarse = 64 * channels * 18, 4 * 18 * 24 + 9 * 24 * 23 + 23 * 4 * 18
    assert 2 * (256 * fine + 64 * coarse) < 6e6


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
@pytest.mark.parametrize("channels", CHANNELS)
def test_shapes_and_batches(channels, batch):
    model = TerrainAutoencoder(channels)
    patches = patch(channels, *batch)
    params = moved(model.init(KEY, patches))
    latent = encode(model, params, patches)
    again = model.apply(params, patches)
    assert latent.shape == (*batch, 16, 16, 18) and again.shape == patches.shape
    last = (-1,) * len(batch)
    single = encode(model, params, patches[last])
    np.testing.assert_allclose(single, latent[last], atol=1e-4)


@pytest.mark.parametrize("channels", CHANNELS)
def test_a_latent_cell_starts_from_the_pixels_under_it(channels):
    # The coarse branch adds nothing before it has learned.
    encoder, x = TerrainEncoder(channels), patch(channels)
    params = encoder.init(KEY, x)
    found = encoder.apply(params, x)
    kernel = np.asarray(params["params"]["cell_kernel"])
    cell = np.asarray(x)[8 * 3 : 8 * 4, 8 * 11 : 8 * 12]
    expected = sum(cell[..., i].ravel() @ kernel[i] for i in range(channels))
    np.testing.assert_allclose(found[3, 11], expected, atol=1e-5)


def test_a_latent_cell_hears_of_its_neighbourhood():
    encoder, x = TerrainEncoder(1), patch(1)
    params = moved(encoder.init(KEY, x))
    gradient = jax.grad(lambda x: jnp.sum(encoder.apply(params, x)[8, 8] ** 2))(x)[..., 0]
    reached = np.abs(np.asarray(gradient)).reshape(16, 8, 16, 8).max((1, 3)) > 0
    # The 2 x 2 cells around it and the eight such squares next to them.
    expected = np.zeros((16, 16), bool)
    expected[6:12, 6:12] = True
    np.testing.assert_array_equal(reached, expected)


def test_decoded_pixels_lie_under_their_cell():
    decoder, latent = TerrainDecoder(1), jnp.zeros((16, 16, 18))
    params = moved(decoder.init(KEY, latent))
    difference = decoder.apply(params, latent.at[4, 9].set(1.0)) - decoder.apply(params, latent)
    changed = np.abs(np.asarray(difference[..., 0])).reshape(16, 8, 16, 8).max((1, 3)) > 0
    expected = np.zeros((16, 16), bool)
    expected[3:6, 8:11] = True
    np.testing.assert_array_equal(changed, expected)


def test_keeps_centimetres_of_relief_before_any_training():
    """A metre grid seen in 0.1 m pixels, bilinear between vertices: steps of some decimetres."""
    vertices = 0.2 * np.random.default_rng(0).normal(size=(15, 15))
    x = scipy.ndimage.zoom(vertices, 10, order=1, mode="grid-constant", grid_mode=True)
    x = jnp.asarray(x[11:139, 11:139, None], jnp.float32)
    model = TerrainAutoencoder(1)
    error = model.apply(model.init(KEY, x), x) - x
    assert float(jnp.std(x)) > 0.1
    assert float(jnp.sqrt(jnp.mean(error**2))) < 0.01


@pytest.mark.parametrize("channels", CHANNELS)
def test_starts_as_a_cosine_transform_cut_to_its_smoothest_modes(channels):
    x = patch(channels)
    model = TerrainAutoencoder(channels)
    found = np.asarray(model.apply(model.init(KEY, x), x))[16:24, 40:48]
    coefficients = scipy.fft.dctn(np.asarray(x)[16:24, 40:48], axes=(0, 1), norm="ortho")
    order = np.add.outer(np.arange(8) ** 2, np.arange(8) ** 2)
    kept = order.ravel().argsort(kind="stable")[: 18 // channels]
    mask = np.isin(np.arange(64), kept).reshape(8, 8, 1)
    expected = scipy.fft.idctn(coefficients * mask, axes=(0, 1), norm="ortho")
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("channels", CHANNELS)
def test_every_weight_learns(channels):
    model, x = TerrainAutoencoder(channels), patch(channels)
    params = moved(model.init(KEY, x))
    gradient = jax.grad(lambda p: jnp.mean((model.apply(p, x) - x) ** 2))(params)
    assert all(bool(jnp.all(g != 0)) for g in jax.tree.leaves(gradient))


@pytest.mark.integration
def test_training_improves_on_the_cosine_transform():
    model, axis = TerrainAutoencoder(1), jnp.arange(128)

    def steps(key):
        """Cliffs across the patch, which smooth modes alone do not hold."""
        place = jax.random.uniform(key, (4, 1, 1), minval=20, maxval=108)
        return jnp.where(axis[:, None] + 0.5 * axis > 1.5 * place, 0.5, -0.5)[..., None]

    def loss(params, x):
        return jnp.mean((model.apply(params, x) - x) ** 2)

    optimiser = optax.adam(3e-3)

    @jax.jit
    def fit(params, keys):
        def update(carry, key):
            params, state = carry
            gradient = jax.grad(loss)(params, steps(key))
            changes, state = optimiser.update(gradient, state)
            return (optax.apply_updates(params, changes), state), None

        return jax.lax.scan(update, (params, optimiser.init(params)), keys)[0][0]

    test = steps(jax.random.key(2))
    params = model.init(KEY, test)
    fitted = fit(params, jax.random.split(jax.random.key(3), 100))
    assert float(loss(fitted, test)) < 0.7 * float(loss(params, test))
