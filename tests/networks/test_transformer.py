import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import sequences

from vertiwm_jax.networks.transformer import KeyValueCache, Transformer

MODEL = Transformer(layers=2, width=24, heads=3, hidden=32, window=5)
KEY = jax.random.key(0)


def empty_cache(batch=(), model=MODEL):
    shape = (*batch, model.heads, model.window, model.width // model.heads)
    return KeyValueCache.empty(model.layers, shape)


PARAMS = MODEL.init(KEY, jnp.zeros(24), empty_cache())


def sequence(*shape: int) -> jax.Array:
    return jax.random.normal(jax.random.key(1), (*shape, MODEL.width))


def whole(params, tokens):
    return sequences.transformer(params["params"], tokens, MODEL.heads, MODEL.window)


@jax.jit
def stepwise(params, tokens, cache):
    """`[T, ..., D]` one after the other through the cache."""

    def advance(cache, token):
        output, cache = MODEL.apply(params, token, cache)
        return cache, output

    cache, outputs = jax.lax.scan(advance, cache, tokens)
    return outputs, cache


def plain_attention_block(block, x, window, period):
    """A NumPy block, written from the equations with a rotation matrix for every pair."""
    width, heads = MODEL.width, MODEL.heads
    d = width // heads

    def norm(x, scale):
        return x / np.sqrt((x**2).mean(-1, keepdims=True) + 1e-6) * scale

    cycles = np.rint(np.geomspace(period / (2 * np.pi), 1, d // 2))
    qkv = norm(x, block["attention_norm"]["scale"]) @ block["query_key_value"]["kernel"]
    q, k, v = (part.reshape(-1, heads, d) for part in np.split(qkv, 3, axis=-1))

    def complex_pairs(a, t):
        return (a[:, : d // 2] + 1j * a[:, d // 2 :]) * np.exp(2j * np.pi * cycles * t / period)

    gathered = np.zeros_like(x)
    for t in range(len(x)):
        seen = range(max(0, t - window + 1), t + 1)
        query = complex_pairs(q[t], t)
        score = [(query * complex_pairs(k[s], s).conj()).real.sum(-1) / np.sqrt(d) for s in seen]
        weight = np.exp(score) / np.exp(score).sum(0)
        gathered[t] = sum(weight[i][:, None] * v[s] for i, s in enumerate(seen)).reshape(-1)
    x = x + gathered @ block["attention_output"]["kernel"]
    hidden = norm(x, block["mlp_norm"]["scale"]) @ block["mlp_hidden"]["kernel"]
    hidden = hidden + block["mlp_hidden"]["bias"]
    hidden = hidden / (1 + np.exp(-hidden))
    return x + hidden @ block["mlp_output"]["kernel"] + block["mlp_output"]["bias"]


def test_steps_equal_a_numpy_transformer():
    # Away from their first values, scales and biases of one and zero would prove nothing.
    params = jax.tree.map(lambda x: x + 0.1 * jnp.cos(jnp.arange(x.size)).reshape(x.shape), PARAMS)
    tokens = sequence(13)
    p = jax.tree.map(lambda x: np.asarray(x, np.float64), params["params"])
    expected = np.asarray(tokens, np.float64)
    for layer in range(MODEL.layers):
        expected = plain_attention_block(p[f"blocks_{layer}"], expected, 5, 80)
    expected /= np.sqrt((expected**2).mean(-1, keepdims=True) + 1e-6)
    expected *= p["norm"]["scale"]
    found, _ = stepwise(params, tokens, empty_cache())
    np.testing.assert_allclose(found, expected, atol=2e-5)
    np.testing.assert_allclose(whole(params, tokens), expected, atol=2e-5)


def test_cached_equals_uncached_beyond_a_rotary_period():
    tokens = sequence(100, 3)  # the period is 80
    outputs, cache = stepwise(PARAMS, tokens, empty_cache((3,)))
    expected = whole(PARAMS, jnp.swapaxes(tokens, 0, 1))
    np.testing.assert_allclose(outputs, jnp.swapaxes(expected, 0, 1), atol=2e-5)
    assert cache.age.dtype == jnp.int32 and cache.age.tolist() == [20, 20, 20]


def test_vmapped_steps_of_vehicles_of_different_ages_equal_uncached():
    tokens = sequence(20, 3)
    older, fresh = 7, jnp.array([False, True, False])
    _, cache = stepwise(PARAMS, tokens[:older], empty_cache((3,)))

    def reset(leaf):
        return jnp.where(fresh.reshape(-1, *[1] * (leaf.ndim - 1)), 0, leaf)

    cache = jax.tree.map(reset, cache)
    run = jax.vmap(stepwise, in_axes=(None, 1, 0), out_axes=(1, 0))
    outputs, _ = run(PARAMS, tokens[older:], cache)
    all_along = whole(PARAMS, jnp.swapaxes(tokens, 0, 1))[:, older:]
    restarted = whole(PARAMS, tokens[older:, 1])
    np.testing.assert_allclose(outputs[:, 0], all_along[0], atol=2e-5)
    np.testing.assert_allclose(outputs[:, 1], restarted, atol=2e-5)
    np.testing.assert_allclose(outputs[:, 2], all_along[2], atol=2e-5)
    assert float(jnp.max(jnp.abs(all_along[1] - restarted))) > 1e-2  # the reset matters


def test_a_token_sees_its_window_and_nothing_else():
    shallow = Transformer(layers=1, width=24, heads=3, hidden=32, window=5)
    params = shallow.init(KEY, jnp.zeros(24), empty_cache(model=shallow))
    tokens = sequence(12)

    def eighth(tokens):
        cache, output = empty_cache(model=shallow), tokens[0]
        for token in tokens[:8]:
            output, cache = shallow.apply(params, token, cache)
        return output

    change = jnp.abs(jax.jacobian(eighth)(tokens)).max((0, 2))
    assert bool(jnp.all(change[3:8] > 1e-4))
    assert bool(jnp.all(change[:3] == 0)) and bool(jnp.all(change[8:] == 0))


def test_order_within_the_window_matters():
    tokens = sequence(5)
    swapped = tokens[jnp.array([1, 0, 2, 3, 4])]
    ordered, other = (stepwise(PARAMS, x, empty_cache())[0] for x in (tokens, swapped))
    difference = ordered[-1] - other[-1]
    assert float(jnp.max(jnp.abs(difference))) > 1e-3


def test_gradients_through_a_scan_of_steps_equal_those_of_the_sequence():
    tokens = sequence(18)

    def cached(params, tokens):
        outputs, _ = stepwise(params, tokens, empty_cache())
        return jnp.mean(jnp.sin(outputs))

    def uncached(params, tokens):
        return jnp.mean(jnp.sin(whole(params, tokens)))

    found = jax.grad(cached, argnums=(0, 1))(PARAMS, tokens)
    expected = jax.grad(uncached, argnums=(0, 1))(PARAMS, tokens)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert bool(jnp.all(jnp.isfinite(ours)))
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_age_stays_bounded_over_long_episodes():
    cache = empty_cache()
    steps = 2000
    _, cache = stepwise(PARAMS, sequence(steps), cache)
    assert 5 <= int(cache.age) < 85 and int(cache.age) % 80 == steps % 80
    assert isinstance(cache, KeyValueCache)


def test_width_must_split_into_pairs_for_every_head():
    with pytest.raises(ValueError, match="width: expected a multiple of twice the 4 heads"):
        model = Transformer(layers=1, width=12, heads=4, hidden=8)
        model.init(KEY, jnp.zeros(12), empty_cache(model=model))
