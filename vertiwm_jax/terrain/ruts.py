"""Ruts: the ground remembers how deep wheels have pressed its soil.

A vehicle carries a window of cells that goes with it. What leaves the window is forgotten.
"""

from dataclasses import replace
from typing import Self

import jax
import jax.numpy as jnp
from flax import struct

CELL_METERS = 0.1
"""Side of a cell."""
CELLS = 320
"""Cells along each side of the window: 32 m."""
_ENTERED = 16
"""Rows and columns that a window moves by at most at once: 1.6 m."""


@struct.dataclass
class Ruts:
    """What one vehicle has pressed into the soil about it.

    depth: `[320, 320]` m below the undisturbed ground, by x and y; cell (i, j) of the world, which
        covers x from 0.1 i and y from 0.1 j, is in row i modulo 320 and column j modulo 320.
    corner: `[2]` int32, the first cell of the window along x and y.
    """

    depth: jax.Array
    corner: jax.Array

    @classmethod
    def none(cls, position: jax.Array) -> Self:
        """Untouched soil about a vehicle at `[3]` m."""
        return cls(jnp.zeros((CELLS, CELLS)), _corner(position[:2]))

    def at(self, x: jax.Array, y: jax.Array) -> jax.Array:
        """`[...]` m, how deep the ruts are at points x, y `[...]` m; 0 outside the window."""
        inside, index = self._stored(x, y)
        flat, index = self.depth.reshape(-1), jnp.where(inside, index, 0)
        depth = flat.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)
        return jnp.where(inside, depth, 0.0)

    def pressed(self, xy: jax.Array, depth: jax.Array) -> Self:
        """Soil at points `[N, 2]` m is `[N]` m deep at least; none outside the window changes."""
        inside, index = self._stored(*xy.T)
        index = jnp.where(inside, index, CELLS**2)
        flat = self.depth.reshape(-1).at[index].max(depth, mode="drop")
        return replace(self, depth=flat.reshape(CELLS, CELLS))

    def followed(self, position: jax.Array) -> Self:
        """The window about a vehicle that is now at `[3]` m, within 1.6 m of where it was."""
        corner = _corner(position[:2])
        moved = jnp.clip(corner - self.corner, -_ENTERED, _ENTERED)
        step = jnp.arange(_ENTERED)[:, None]
        # Those beyond the end that it moves to; the others are named as none at all.
        first = jnp.where(moved > 0, self.corner + CELLS, self.corner + moved)
        fresh = jnp.where(step < jnp.abs(moved), (first + step) % CELLS, CELLS)
        depth = self.depth.at[fresh[:, 0]].set(0.0, mode="drop")
        depth = depth.at[:, fresh[:, 1]].set(0.0, mode="drop")
        return replace(self, depth=depth, corner=self.corner + moved)

    def _stored(self, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Whether points lie in the window, and where their cells lie in `depth`, flat."""
        inside, index = jnp.bool(True), jnp.int32(0)
        for meters, first in zip((x, y), self.corner, strict=True):
            place = _cells(meters) - first
            inside &= (place >= 0) & (place < CELLS)
            # Without a division for each point, of which patches have many.
            stored = place + first % CELLS
            index = CELLS * index + jnp.where(stored < CELLS, stored, stored - CELLS)
        return inside, index


def _cells(xy: jax.Array) -> jax.Array:
    """`[..., 2]` int32 cells in which points `[..., 2]` m lie."""
    return jnp.floor(xy / CELL_METERS).astype(jnp.int32)


def _corner(xy: jax.Array) -> jax.Array:
    return _cells(xy) - CELLS // 2
