import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.world_model.batching import few_at_a_time


def function(params, x, key):
    """Of one vehicle: of shared numbers, an array of its own, and nested results."""
    return {"sum": jnp.sum(params["w"] * x), "all": (x + params["b"], key * 2)}


PARAMS = {"w": jnp.arange(3.0), "b": jnp.float32(0.5)}


@pytest.mark.parametrize("size", [1, 3, 4, 12, 13, 37, 64])
def test_a_batch_is_that_of_vmap(size):
    x = jax.random.normal(jax.random.key(0), (size, 3))
    keys, axes = jnp.arange(size), (None, 0, 0)
    found = jax.jit(jax.vmap(few_at_a_time(function, 4), axes))(PARAMS, x, keys)
    expected = jax.vmap(function, axes)(PARAMS, x, keys)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), found, expected)


def test_batches_of_batches_and_several_axes():
    x, w = jax.random.normal(jax.random.key(0), (2, 5, 24, 3))
    few = few_at_a_time(lambda w, x: jnp.dot(w, x), 4)
    of_both = jax.jit(jax.vmap(jax.vmap(few, (0, 1)), (0, 0)))(w, jnp.swapaxes(x, 1, 2))
    np.testing.assert_allclose(of_both, jnp.sum(w * x, axis=-1), rtol=1e-4, atol=1e-6)


def largest_batch(size, number):
    """Vehicles that any operation of a compiled batch computes at once."""
    few = few_at_a_time(lambda x: jnp.sin(x) @ jnp.ones((3, 7)), number)
    text = jax.jit(jax.vmap(few)).lower(jnp.ones((size, 3))).as_text()
    lines = [line for line in text.splitlines() if "dot_general" in line]
    shapes = [line.rpartition("-> tensor<")[2].split("x")[0] for line in lines]
    return max(int(shape) for shape in shapes)


def test_only_a_few_are_computed_at_once():
    assert largest_batch(64, 16) == 16
    assert largest_batch(20, 16) == 20  # and not 16 and 4
    assert largest_batch(36, 16) == 18
    assert largest_batch(37, 16) == 16


def test_one_alone_and_under_a_derivative_of_something_else():
    few = few_at_a_time(lambda x: jnp.sin(x), 4)
    np.testing.assert_allclose(few(jnp.float32(0.3)), np.sin(0.3), rtol=1e-6)
    slope = jax.grad(lambda y: jnp.sum(y * jax.vmap(few)(jnp.arange(8.0))))(jnp.ones(8))
    np.testing.assert_allclose(slope, np.sin(np.arange(8.0)), rtol=1e-5, atol=1e-6)
