"""The recurrent gate that weighs the two specialists (Sec. IV-C)."""

import flax.linen as nn
import jax
import jax.numpy as jnp

HIDDEN = 64
"""Width of the gate's recurrent state."""


class TwoBiasGRU(nn.Module):
    """A gated recurrent unit with a bias for the input and another for the state.

    The formulation of Cho et al. (2014) as cuDNN and PyTorch have it: the reset gate acts on the
    state's part of the candidate after its bias. 24,960 parameters for 64 inputs and 64 units.
    """

    @nn.compact
    def __call__(self, x: jax.Array, hidden: jax.Array) -> jax.Array:
        """`[..., I]` input and `[..., H]` state to the next state `[..., H]`."""
        width = hidden.shape[-1]
        recurrent = nn.Dense(3 * width, kernel_init=nn.initializers.orthogonal(), name="state")
        x_reset, x_update, x_candidate = jnp.split(nn.Dense(3 * width, name="input")(x), 3, axis=-1)
        h_reset, h_update, h_candidate = jnp.split(recurrent(hidden), 3, axis=-1)
        reset = nn.sigmoid(x_reset + h_reset)
        update = nn.sigmoid(x_update + h_update)
        candidate = jnp.tanh(x_candidate + reset * h_candidate)
        return (1 - update) * candidate + update * hidden


class Gate(nn.Module):
    """G of Eq. 6: four unconstrained outputs from the fusion context, with memory.

    The outputs start at zero, whatever the context, so that learning starts from equal weights
    of the specialists (Eq. 7). 33,764 parameters for a context of 68, 37,220 for 104.
    """

    @nn.compact
    def __call__(self, context: jax.Array, hidden: jax.Array) -> tuple[jax.Array, jax.Array]:
        """`[..., C]` context and `[..., 64]` state to outputs `[..., 4]` and the next state."""
        hidden = TwoBiasGRU()(nn.Dense(HIDDEN)(context), hidden)
        features = nn.silu(nn.Dense(32)(jnp.concatenate([hidden, context], axis=-1)))
        return nn.Dense(4, kernel_init=nn.initializers.zeros)(features), hidden
