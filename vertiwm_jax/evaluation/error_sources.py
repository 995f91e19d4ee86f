"""Where the error of a prediction lives: by speed, slope, ground, belly contact and border."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.evaluation.tables import markdown
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap

SPEEDS = (0.5, 1.5, 2.5, 3.5)  # m/s
TILTS = (5.0, 10.0, 20.0)  # deg
DISTANCES = (1.0, 2.0, 4.0, 8.0)  # m
_DIRECTIONS = 16


@dataclass(frozen=True)
class Share:
    """The windows of which something holds.

    quantity, value: what holds. windows: their share. mean: their mean error, m. error: their
    share of the sum of all errors.
    """

    quantity: str
    value: str
    windows: float
    mean: float
    error: float


def locate(test: TestWindows, error: np.ndarray) -> list[Share]:
    """Shares of the final position errors `[N]` m, by what was recorded in the predicted steps."""
    c = test.windows.context
    state = np.asarray(test.windows.state)
    tilt = np.degrees(np.abs(state[:, c:, 3:5]).max(axis=2).mean(axis=1))
    kind, distance = _ground(test)
    quantities: dict[str, Sequence[str]] = {
        "speed at the start, m/s": _binned(np.linalg.norm(state[:, c, 6:9], axis=1), SPEEDS),
        "roll or pitch, deg": _binned(tilt, TILTS),
        "ground under the vehicle": [test.terrain.class_names[i] for i in kind],
        "border of soil, m away": _binned(distance, DISTANCES),
    }
    force = test.windows.wheels.chassis_force
    if force is not None:
        touched = np.linalg.norm(force[:, c + 1 :], axis=-1).max(axis=1) > 0
        quantities["belly"] = [("free", "on the ground")[i] for i in touched.astype(int)]
    return [
        _share(name, value, np.array([v == value for v in values]), error)
        for name, values in quantities.items()
        for value in sorted(set(values), key=_order)
    ]


def format_shares(shares: Sequence[Share]) -> str:
    """A Markdown table."""
    rows, before = [], ""
    for x in shares:
        name = x.quantity if x.quantity != before else ""
        before = x.quantity
        rows.append((name, x.value, f"{x.windows:.0%}", f"{x.mean:.3f}", f"{x.error:.0%}"))
    return markdown(["", "", "windows", "mean error, m", "share of the error"], rows)


def _share(quantity: str, value: str, rows: np.ndarray, error: np.ndarray) -> Share:
    return Share(
        quantity=quantity,
        value=value,
        windows=float(rows.mean()),
        mean=float(error[rows].mean()),
        error=float(error[rows].sum() / max(error.sum(), 1e-12)),
    )


def _binned(values: np.ndarray, edges: tuple[float, ...]) -> list[str]:
    names = [f"below {edges[0]:g}"]
    names += [f"{low:g} to {high:g}" for low, high in itertools.pairwise(edges)]
    names.append(f"{edges[-1]:g} and more")
    return [names[i] for i in np.digitize(values, edges)]


def _order(value: str) -> tuple[float, str]:
    """Sorts bins by their lower edge, and names by the alphabet."""
    first = value.split()[0]
    return (float(first) if first.replace(".", "").isdecimal() else 0.0), value


@jax.jit
def _classes_around(terrain: TerrainMap, windows: Windows) -> tuple[jax.Array, jax.Array]:
    """Class below the last context state, and whether it is soil there and around."""
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
