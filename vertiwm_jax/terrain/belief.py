"""What is believed of a map of which only a part is known."""

import jax
from flax import struct


@struct.dataclass
class MapBelief:
    """What one vehicle knows of the selected world, and what it takes the rest to be.

    known: `[n, n]` bool, of cells that tile the map, row 0 the northernmost.
    plane: `[3]` of unknown ground: its height at x = y = 0, m, and its slopes along x and y.
    semantic: `[]` int32 class id; friction: `[]` friction coefficient, both of unknown ground.
    """

    known: jax.Array
    plane: jax.Array
    semantic: jax.Array
    friction: jax.Array
