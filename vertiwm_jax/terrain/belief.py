"""What a vehicle knows and assumes of a map that is known in part."""

import jax
from flax import struct


@struct.dataclass
class MapBelief:
    """The cells of the selected world that a vehicle knows, and its assumption about the rest.

    known: `[n, n]` bool, for cells that tile the map; row 0 is the northernmost.
    plane: `[3]` of unknown ground: its height at x = y = 0, m, and its slopes along x and y.
    semantic: `[]` int32 class id; friction: `[]` friction coefficient, both of unknown ground.
    """

    known: jax.Array
    plane: jax.Array
    semantic: jax.Array
    friction: jax.Array
