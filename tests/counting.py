"""The simplest algorithm that can be trained."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.training import Algorithm


@struct.dataclass
class Counter:
    count: jax.Array


@dataclass(frozen=True)
class Counting(Algorithm[Counter]):
    """It counts from its data; beyond a million it is lost."""

    def init(self, data, key):
        return Counter(data)

    def iterate(self, data, state):
        metrics = {"finite": state.count < 1e6, "count": state.count, "never": jnp.nan}
        return Counter(state.count + 1), metrics
