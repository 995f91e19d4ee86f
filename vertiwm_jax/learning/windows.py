"""Prediction windows: their places in drives, and their contents."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike

from vertiwm_jax.learning.dataset import Array, Drives, WheelSignals
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain.map import TerrainMap

GROUNDS = ("rigid", "deformable", "transition")
"""Kinds of window, by the ground under the wheels: all rigid, all soil, or both."""


@struct.dataclass
class WindowIndex:
    """Places in drives of N windows with C context steps and K steps to predict.

    drive: `[N]`; start: `[N]` first step of the context; ground: `[N]` index into `GROUNDS`, over
    the predicted steps; context: C, static; horizon: K, static.
    """

    drive: jax.Array
    start: jax.Array
    ground: jax.Array
    context: int = struct.field(pytree_node=False)
    horizon: int = struct.field(pytree_node=False)


@struct.dataclass
class Windows:
    """N windows with C context steps and K steps to predict.

    state: `[N, C + K + 1, 12]`; control: `[N, C + K, 2]`; world: `[N]`;
    ground: `[N]` index into `GROUNDS`, over the predicted steps; context: C, static;
    wheels: leaves `[N, C + K + 1, ...]`, as far as the drives have them.
    """

    state: jax.Array
    control: jax.Array
    world: jax.Array
    ground: jax.Array
    context: int = struct.field(pytree_node=False)
    wheels: WheelSignals = WheelSignals()

    @property
    def commanded_way(self) -> np.ndarray:
        """`[N]` m, how far the vehicle is told to drive, forwards or backwards, while predicted."""
        speed = np.abs(np.asarray(self.control)[:, self.context :, 0])
        return STEP_SECONDS * speed.sum(axis=1)


def way(position: np.ndarray) -> np.ndarray:
    """`[N, K + 1, 3]` positions to the `[N]` lengths, m, of the ways through them."""
    return np.linalg.norm(np.diff(position, axis=1), axis=-1).sum(axis=1)


def index(
    drives: Drives, terrain: TerrainMap, context: int = 16, horizon: int = 16, stride: int = 4
) -> WindowIndex:
    """All windows of `context` recorded and `horizon` predicted steps, every `stride` steps.

    `DataError` when no drive is long enough.
    """
    length = np.asarray(drives.length)
    places = [
        (drive, start)
        for drive, steps in enumerate(length)
        for start in range(0, int(steps) - context - horizon + 1, stride)
    ]
    if not places:
        raise DataError(
            f"expected drives of at least {context + horizon} steps, "
            f"found at most {int(length.max())}"
        )
    drive, start = np.array(places, np.int32).T
    steps = start[:, None] + context + np.arange(horizon + 1)
    soft = np.asarray(terrain.deformable)[np.asarray(drives.wheel_class)]
    share = soft.mean(axis=-1)[drive[:, None], steps].mean(axis=-1)
    ground = np.where(share == 0, 0, np.where(share == 1, 1, 2)).astype(np.int32)
    drive, start, ground = map(jnp.asarray, (drive, start, ground))
    return WindowIndex(drive, start, ground, context, horizon)


@jax.jit
def gather(drives: Drives, index: WindowIndex, rows: ArrayLike | None = None) -> Windows:
    """Copies the windows at `index`, or those in some of its rows.

    Pass drives that lie on the device (`jax.device_put`) when this is called more than once.
    """
    if rows is not None:
        index = jax.tree.map(lambda x: x[rows], index)
    steps = index.start[:, None] + jnp.arange(index.context + index.horizon + 1)

    def cut_out(array: Array, steps: jax.Array) -> jax.Array:
        return jnp.asarray(array).at[index.drive[:, None], steps].get(mode="promise_in_bounds")

    return Windows(
        state=cut_out(drives.state, steps),
        control=cut_out(drives.control, steps[:, :-1]),
        world=jnp.asarray(drives.world)[index.drive],
        ground=index.ground,
        context=index.context,
        wheels=jax.tree.map(partial(cut_out, steps=steps), drives.wheels),
    )
