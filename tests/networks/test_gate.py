import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.networks.gate import HIDDEN, Gate, TwoBiasGRU

KEYS = jax.random.split(jax.random.key(0), 4)


def count(params) -> int:
    return sum(x.size for x in jax.tree.leaves(params))


@pytest.mark.parametrize(("context", "parameters"), [(68, 33_764), (104, 37_220)])
def test_parameters_are_those_of_the_paper(context, parameters):
    params = Gate().init(KEYS[0], jnp.zeros(context), jnp.zeros(HIDDEN))
    assert count(params) == parameters


def test_gru_equals_the_two_bias_equations():
    x, hidden = jax.random.normal(KEYS[1], (7, 64)), jax.random.normal(KEYS[2], (7, 64))
    params = TwoBiasGRU().init(KEYS[0], x, hidden)
    assert count(params) == 24_960
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(KEYS[3], len(leaves))
    drawn = [0.3 * jax.random.normal(k, a.shape) for k, a in zip(keys, leaves, strict=True)]
    params = jax.tree.unflatten(tree, drawn)  # biases that are not zero

    # h' = (1 - z) n + z h with W_ir, W_iz, W_in and W_hr, W_hz, W_hn stacked in this order, as
    # the documentation of torch.nn.GRUCell has it.
    p = jax.tree.map(lambda a: np.asarray(a, np.float64), params["params"])
    w_i, b_i = p["input"]["kernel"].T, p["input"]["bias"]
    w_h, b_h = p["state"]["kernel"].T, p["state"]["bias"]
    found = TwoBiasGRU().apply(params, x, hidden)
    for row in range(7):
        a = w_i @ np.asarray(x[row], np.float64) + b_i
        h = np.asarray(hidden[row], np.float64)
        b = w_h @ h + b_h
        r = 1 / (1 + np.exp(-(a[:64] + b[:64])))
        z = 1 / (1 + np.exp(-(a[64:128] + b[64:128])))
        n = np.tanh(a[128:] + r * b[128:])
        np.testing.assert_allclose(found[row], (1 - z) * n + z * h, atol=1e-5)


def test_first_outputs_are_zero_and_learn():
    gate = Gate()
    context, hidden = jax.random.normal(KEYS[1], (5, 3, 68)), jnp.zeros((5, 3, HIDDEN))
    params = gate.init(KEYS[0], context, hidden)
    outputs, state = gate.apply(params, context, hidden)
    assert outputs.shape == (5, 3, 4) and state.shape == (5, 3, HIDDEN)
    assert bool(jnp.all(outputs == 0)) and bool(jnp.any(state != 0))
    gradient = jax.grad(lambda p: jnp.sum(gate.apply(p, context, hidden)[0]))(params)
    assert any(bool(jnp.any(g != 0)) for g in jax.tree.leaves(gradient))


def test_outputs_depend_on_the_context_directly_and_through_the_state():
    gate = Gate()
    context, hidden = jax.random.normal(KEYS[1], (68,)), jax.random.normal(KEYS[2], (HIDDEN,))
    params = gate.init(KEYS[0], context, hidden)
    params = jax.tree.map(lambda x: jnp.where(x == 0, 0.1, x), params)

    def output(context, hidden):
        return gate.apply(params, context, hidden)[0]

    by_context, by_state = jax.jacobian(output, argnums=(0, 1))(context, hidden)
    assert bool(jnp.all(jnp.any(by_context != 0, axis=0)))
    assert bool(jnp.all(jnp.any(by_state != 0, axis=0)))
