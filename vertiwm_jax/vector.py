"""Vectors as tuples of components.

With a trailing axis of length three XLA loops over three numbers at a time, which wastes the vector
units of a CPU. With one array per component, every operation runs over all wheels of all
vehicles at once. Components may have any equal shapes `[...]`.
"""

import functools
from collections.abc import Iterable
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp


class Vector(NamedTuple):
    """A three-vector; each component `[...]`."""

    x: jax.Array
    y: jax.Array
    z: jax.Array

    @classmethod
    def of(cls, array: jax.Array) -> Self:
        """`[..., 3]` to a vector."""
        return cls(array[..., 0], array[..., 1], array[..., 2])

    def stacked(self) -> jax.Array:
        """The `[..., 3]` array."""
        return jnp.stack(self, axis=-1)

    def plus(self, other: "Vector", scale: jax.Array | float = 1.0) -> "Vector":
        """self + scale other."""
        return Vector(*(a + scale * b for a, b in zip(self, other, strict=True)))

    def times(self, scale: jax.Array | float) -> "Vector":
        return Vector(*(scale * a for a in self))

    def dot(self, other: "Vector") -> jax.Array:
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: "Vector") -> "Vector":
        return Vector(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    def normalized(self) -> "Vector":
        """Unit length; the vector must not be zero."""
        return self.times(jax.lax.rsqrt(self.dot(self)))


def sum_of(vectors: Iterable[Vector]) -> Vector:
    """The sum of one or more."""
    first, *others = vectors
    return functools.reduce(Vector.plus, others, first)


class Axes(NamedTuple):
    """A rotation from body to world, as the body's axes in world coordinates."""

    x: Vector
    y: Vector
    z: Vector

    @classmethod
    def from_quaternion(cls, quaternion: jax.Array) -> Self:
        """Unit quaternion `[..., 4]` (w, x, y, z) to the body's axes."""
        w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
        return cls(
            Vector(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
            Vector(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
            Vector(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
        )

    def to_world(self, v: Vector) -> Vector:
        """Body components to world components."""
        return self.x.times(v.x).plus(self.y, v.y).plus(self.z, v.z)

    def to_body(self, v: Vector) -> Vector:
        """World components to body components."""
        return Vector(self.x.dot(v), self.y.dot(v), self.z.dot(v))
