"""Where the prediction error comes from: by speed, slope, ground, belly contact and border."""

import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.evaluation.tables import Row
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap

SPEEDS = (0.5, 1.5, 2.5, 3.5)  # m/s
TILTS = (5.0, 10.0, 20.0)  # deg
DISTANCES = (1.0, 2.0, 4.0, 8.0)  # m
_DIRECTIONS = 16


def shares(test: TestWindows, error: np.ndarray) -> list[Row]:
    """Groups windows by what was recorded in the predicted steps.

    Args:
        test: N windows.
        error: `[N]` m, position errors after the last step.

    Returns:
        A row for each group: its share of all windows, %, its mean error, m, and its share of the
        sum of all errors, %.
    """
    c = test.windows.context
    state = np.asarray(test.windows.state)
    tilt = np.degrees(np.abs(state[:, c:, 3:5]).max(axis=2).mean(axis=1))
    kind, distance = _ground(test)
    groups = {
        "speed at the start, m/s": _binned(np.linalg.norm(state[:, c, 6:9], axis=1), SPEEDS),
        "roll or pitch, deg": _binned(tilt, TILTS),
        "ground under the vehicle": (test.terrain.class_names, kind),
        "border of soil, m away": _binned(distance, DISTANCES),
    }
    force = test.windows.wheels.chassis_force
    if force is not None:
        touches = np.linalg.norm(force[:, c + 1 :], axis=-1).max(axis=1) > 0
        groups["belly"] = ("free", "on the ground"), touches.astype(int)
    rows = []
    for quantity, (names, group) in groups.items():
        for i in np.unique(group):
            inside = group == i
            rows.append(
                {
                    "quantity": quantity,
                    "value": names[i],
                    "windows, %": 100 * float(inside.mean()),
                    "mean error, m": float(error[inside].mean()),
                    "error, %": 100 * float(error[inside].sum() / max(error.sum(), 1e-12)),
                }
            )
    return rows


def _binned(values: np.ndarray, edges: Sequence[float]) -> tuple[list[str], np.ndarray]:
    """Names of all bins, and `[N]` the bin of each value."""
    between = [f"{low:g} to {high:g}" for low, high in itertools.pairwise(edges)]
    names = [f"below {edges[0]:g}", *between, f"{edges[-1]:g} and more"]
    return names, np.digitize(values, edges)


@jax.jit
def _classes_around(terrain: TerrainMap, windows: Windows) -> tuple[jax.Array, jax.Array]:
    """`[N]` class below the last context state, and `[N, 4]` whether soil begins or ends around it.

    The second is told for each of `DISTANCES`.
    """
    angle = jnp.arange(_DIRECTIONS) * (2 * jnp.pi / _DIRECTIONS)
    ring = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    rings = jnp.asarray(DISTANCES)[:, None, None] * ring

    def one(window: Windows) -> tuple[jax.Array, jax.Array]:
        world, xy = terrain.select(window.world), window.state[window.context, :2]
        kind = query.surface(world, xy).semantic
        around = query.surface(world, xy + rings).semantic
        return kind, jnp.any(terrain.deformable[around] != terrain.deformable[kind], axis=-1)

    return jax.vmap(one)(windows)


def _ground(test: TestWindows) -> tuple[np.ndarray, np.ndarray]:
    """`[N]` class below the vehicle at the start, and distance m to where it is soil or not."""
    kind, differs = map(np.asarray, _classes_around(test.terrain, test.windows))
    beyond = np.where(differs.any(axis=1), differs.argmax(axis=1), len(DISTANCES))
    # A ring that meets other ground puts the border within it and outside the one before.
    return kind, np.append(DISTANCES, np.inf)[beyond] - 1e-6
