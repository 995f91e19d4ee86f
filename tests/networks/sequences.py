"""Whole sequences of tokens at once, from the equations: what steps through a cache must equal."""

import jax
import jax.numpy as jnp
import numpy as np


def transformer(weights, tokens, heads, window):
    """`[..., T, D]` to `[..., T, D]`; the first token has no past."""
    layers = sum(name.startswith("blocks_") for name in weights)
    for layer in range(layers):
        tokens = _block(weights[f"blocks_{layer}"], tokens, heads, window)
    return _norm(tokens, weights["norm"])


def specialist(weights, inputs, ground, size, window):
    """`[..., T, F]` of steps and `[..., T, G]` of the ground to `[..., T, 12]`."""
    tokens = inputs @ weights["embed"]["kernel"] + weights["embed"]["bias"]
    if ground is not None:
        tokens = tokens + ground @ weights["embed_ground"]["kernel"]
    tokens = transformer(weights["transformer"], tokens, size.heads, window)
    return tokens @ weights["head"]["kernel"] + weights["head"]["bias"]


def _norm(x, weights):
    return x / jnp.sqrt(jnp.mean(x**2, -1, keepdims=True) + 1e-6) * weights["scale"]


def _block(weights, x, heads, window):
    length, width = x.shape[-2:]
    projected = _norm(x, weights["attention_norm"]) @ weights["query_key_value"]["kernel"]
    q, k, v = (part.reshape(*x.shape[:-1], heads, -1) for part in jnp.split(projected, 3, axis=-1))
    pairs, period = width // heads // 2, 16 * window
    cycles = np.rint(np.geomspace(period / (2 * np.pi), 1, pairs))
    time = np.arange(length)
    turn = np.exp(2j * np.pi * cycles * time[:, None] / period)[:, None]  # [T, 1, d / 2]

    def turned(a):
        first, second = a[..., :pairs], a[..., pairs:]
        real = first * turn.real - second * turn.imag
        return jnp.concatenate([real, first * turn.imag + second * turn.real], axis=-1)

    score = jnp.einsum("...qhd,...khd->...hqk", turned(q), turned(k)) / np.sqrt(2 * pairs)
    past = time[:, None] - time
    share = jax.nn.softmax(jnp.where((past >= 0) & (past < window), score, -1e30), axis=-1)
    gathered = jnp.einsum("...hqk,...khd->...qhd", share, v).reshape(x.shape)
    x = x + gathered @ weights["attention_output"]["kernel"]
    hidden = _norm(x, weights["mlp_norm"]) @ weights["mlp_hidden"]["kernel"]
    hidden = jax.nn.silu(hidden + weights["mlp_hidden"]["bias"])
    return x + hidden @ weights["mlp_output"]["kernel"] + weights["mlp_output"]["bias"]
