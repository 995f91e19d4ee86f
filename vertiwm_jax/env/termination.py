"""How an episode ends."""

import enum
import functools

import jax
import jax.numpy as jnp

from vertiwm_jax.terrain.map import TerrainMap


class TerminationReason(enum.IntEnum):
    """Why an episode is over: `TIMED_OUT` truncates it, all later ones terminate it."""

    RUNNING = 0
    TIMED_OUT = 1
    GOAL = 2
    STUCK = 3
    COLLIDED = 4
    OFF_MAP = 5
    ROLLED_OVER = 6
    DIVERGED = 7


def first_ending(conditions: dict[TerminationReason, jax.Array]) -> jax.Array:
    """`[...]` int32 code of the most severe condition that holds; `RUNNING` if none does.

    The largest code is the most severe: a vehicle that reaches the goal on its roof has rolled
    over.
    """
    running = jnp.int32(TerminationReason.RUNNING)
    found = [jnp.where(holds, jnp.int32(code), running) for code, holds in conditions.items()]
    return functools.reduce(jnp.maximum, found)


def is_terminal(ending: jax.Array) -> jax.Array:
    """`[...]` whether the code terminates an episode; running out of time does not."""
    return ending > TerminationReason.TIMED_OUT


def edge_distance(terrain: TerrainMap, xy: jax.Array) -> jax.Array:
    """`[..., 2]` points to `[...]` m from the nearest edge of the map, negative outside."""
    # Down from the northern edge, right from the western one.
    inward = (xy - terrain.origin) * jnp.array([1.0, -1.0])
    return jnp.min(jnp.minimum(inward, terrain.size - inward), axis=-1)
