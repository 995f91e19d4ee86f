"""Everything is computed in float32, also where JAX is told to compute in float64."""

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp

P = ParamSpec("P")
T = TypeVar("T")


def float32(function: Callable[P, T]) -> Callable[P, T]:
    """The function as it is without `jax_enable_x64`; wide arrays that it is given are narrowed."""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        if not jax.config.read("jax_enable_x64"):
            return function(*args, **kwargs)
        with jax.enable_x64(False):
            args, kwargs = jax.tree.map(_narrowed, (args, kwargs))
            return function(*args, **kwargs)

    return call


def _narrowed(x: Any) -> Any:
    wide = isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.number)
    return x.astype(jax.dtypes.canonicalize_dtype(x.dtype)) if wide else x
