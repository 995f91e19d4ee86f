"""Batches in an order that keeps what is computed in the cache of a core."""

from collections.abc import Callable, Hashable
from functools import cache, partial
from typing import Any

import jax
from jax.custom_batching import custom_vmap


@cache  # one for each, so that what was traced is found again
def few_at_a_time(
    function: Callable[..., Any], number: int, *static: Hashable
) -> Callable[..., Any]:
    """`function` of one vehicle, whose batches a CPU computes about `number` vehicles at a time.

    static: its first arguments, the others are given in calls.
    The result is that of `vmap`, which computes one operation of all vehicles after the other:
    where every vehicle needs hundreds of kB, all of it goes to memory and back between any two. For
    pure functions of arrays that no gradient flows through; other platforms take all at once.
    """
    # Both ways to compute many share its trace.
    function = jax.jit(partial(function, *static), inline=True)
    of_one = custom_vmap(function)

    @of_one.def_vmap
    def of_many(size: int, batched: list[Any], *args: Any) -> tuple[Any, Any]:
        leaves, structure = jax.tree.flatten(args)
        is_batched = jax.tree.leaves(batched)

        def one(own: list[jax.Array]) -> Any:
            of_it, both = iter(own), zip(leaves, is_batched, strict=True)
            mixed = [next(of_it) if mapped else shared for shared, mapped in both]
            return function(*jax.tree.unflatten(structure, mixed))

        each = [leaf for leaf, mapped in zip(leaves, is_batched, strict=True) if mapped]
        together, few = jax.vmap(one), _few(size, number)
        if few < size:
            result = jax.lax.platform_dependent(
                each, cpu=lambda each: jax.lax.map(one, each, batch_size=few), default=together
            )
        else:
            result = together(each)
        return result, jax.tree.map(lambda _: True, result)

    return of_one


def _few(size: int, number: int) -> int:
    """How many of a batch at a time: half to twice the number, so that none are left, if it can."""
    even = [few for few in range(number // 2, 2 * number + 1) if size % few == 0]
    return min(even, key=lambda few: abs(few - number), default=min(number, size))
