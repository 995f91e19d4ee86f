"""Layers that compute as precisely as their weights are stored."""

from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp


def _as_kernel(*operands: Any, **_: Any) -> list[Any]:
    inputs, kernel, bias = operands
    return [inputs.astype(kernel.dtype), kernel, bias]


Dense = partial(
    nn.Dense,
    promote_dtype=_as_kernel,
    dot_general=partial(jax.lax.dot_general, preferred_element_type=jnp.float32),
)
"""`nn.Dense` whose operands are rounded as its kernel is, to bfloat16 perhaps; sums are float32."""
