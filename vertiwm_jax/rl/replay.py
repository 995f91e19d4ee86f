"""Replay: what was experienced, kept on the device to be learned from again."""

from dataclasses import replace
from typing import Any, Self

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Replay:
    """A ring buffer of rows.

    rows: leaves `[capacity, ...]`; place: `[]` int32 where the next row goes; filled: `[]` int32
    rows that hold something.
    """

    rows: Any
    place: jax.Array
    filled: jax.Array

    @classmethod
    def create(cls, row: Any, capacity: int) -> Self:
        """Room for `capacity` rows like `row`, leaves `[...]`."""
        rows = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), row)
        return cls(rows, jnp.int32(0), jnp.int32(0))

    def add(self, rows: Any) -> Self:
        """With N more rows, leaves `[N, ...]`, in place of the oldest; N divides the capacity."""
        capacity, number = (len(jax.tree.leaves(x)[0]) for x in (self.rows, rows))
        assert capacity % number == 0, (capacity, number)

        def write(ring: jax.Array, new: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_slice_in_dim(ring, new, self.place, axis=0)

        return replace(
            self,
            rows=jax.tree.map(write, self.rows, rows),
            place=(self.place + number) % capacity,
            filled=jnp.minimum(self.filled + number, capacity),
        )

    def sample(self, key: jax.Array, number: int) -> Any:
        """Rows drawn evenly with replacement, leaves `[number, ...]`; it must hold some."""
        chosen = jax.random.randint(key, (number,), 0, self.filled)
        return jax.tree.map(lambda x: x[chosen], self.rows)
