"""What ruts change: the cost of a step, and predictions of drives that cross their own tracks.

Every drive is followed from its beginning, so that the ground knows all ruts of it, and predicted
open-loop every 1.6 s. Windows count as crossing where a wheel comes within 0.15 m of where one was,
3 s or more before, on soil.
"""

from argparse import Namespace
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from benchmarks._harness import Figures, measure, parser, report
from vertiwm_jax import dynamics
from vertiwm_jax.dynamics import Dynamics
from vertiwm_jax.evaluation.prediction import bootstrap
from vertiwm_jax.learning.dataset import FITTED, Drives, load_drives
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import Vehicle, load_vehicle
from vertiwm_jax.models.registry import Imagined, load_model, moves_any, moving
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap

STEPS = 16
NEAR, EARLIER = 0.15, 30
MODELS: tuple[Imagined, ...] = ("builtin", "nesam", "vertiwm")
BATCH = 32


@partial(jax.jit, static_argnames="model")
def errors(
    model: Dynamics, params: Any, terrain: TerrainMap, drives: Any, driven: Vehicle
) -> jax.Array:
    """`[D, B]` m, position errors after 16 steps, of each block of as many in D drives."""
    see = getattr(model, "see", None)

    def of_one(drive: tuple[jax.Array, ...]) -> jax.Array:
        state, control, world = drive
        ground = terrain.select(world)
        own = params(driven.select(world)) if isinstance(params, Partial) else params
        states, commands = VehicleState.from_vector(state), Command.from_vector(control)

        def follow(history: Any, given: tuple[VehicleState, VehicleState, Command]) -> Any:
            before, after, command = given
            _, history = dynamics.step(model, own, ground, history, before, command)
            if see:
                looked = see(own, dynamics.rutted(ground, history), after)
                history = replace(history, features=looked)
            return history, None

        def block(history: Any, first: jax.Array) -> tuple[Any, jax.Array]:
            def cut(tree: Any, start: jax.Array) -> Any:
                part = partial(jax.lax.dynamic_slice_in_dim, slice_size=STEPS)
                return jax.tree.map(lambda x: part(x, start), tree)

            before, after = cut(states, first), cut(states, first + 1)
            begin = jax.tree.map(lambda x: x[0], before)
            going = cut(commands, first)
            found = dynamics.rollout(model, own, ground, begin, going, history)
            history, _ = jax.lax.scan(follow, history, (before, after, going))
            return history, jnp.linalg.norm(found.position[-1] - after.position[-1])

        start = jax.tree.map(lambda x: x[0], states)
        firsts = jnp.arange(0, control.shape[0] - STEPS + 1, STEPS)
        return jax.lax.scan(block, model.init(own, ground, start), firsts)[1]

    return jax.lax.map(of_one, drives, batch_size=BATCH)


def crossing(drives: Drives, terrain: TerrainMap, driven: Vehicle) -> np.ndarray:
    """`[D, B]` whether a wheel finds an older track on soil in a block of `errors`."""
    found = []
    for i, state in enumerate(np.asarray(drives.state)):
        corner = np.asarray(driven.select(drives.world[i]).wheel_position)[:, :2]
        cos, sin = np.cos(state[:, 5, None]), np.sin(state[:, 5, None])
        x = state[:, :1] + cos * corner[:, 0] - sin * corner[:, 1]
        y = state[:, 1:2] + sin * corner[:, 0] + cos * corner[:, 1]
        soft = np.asarray(terrain.deformable)[np.asarray(drives.wheel_class[i])]
        apart = np.hypot(x[:, :, None, None] - x, y[:, :, None, None] - y)
        steps = np.arange(len(state))
        older = steps[:, None] - steps >= EARLIER
        near = (apart < NEAR) & older[:, None, :, None] & soft[:, :, None, None]
        finds = near.any(axis=(1, 2, 3))
        blocks = range(0, len(state) - STEPS, STEPS)
        long = int(drives.length[i])
        found.append([finds[b : b + STEPS].any() and b + STEPS <= long for b in blocks])
    return np.array(found)


def predicted(options: Namespace) -> dict[str, Figures]:
    drives, terrain = load_drives(options.data, options.split, FITTED, wheels=False)
    hmmwv = load_vehicle()
    driven = drives.driven(hmmwv)
    described = any(drives.described)
    chosen = crossing(drives, terrain, driven)
    drive = np.broadcast_to(np.arange(len(chosen))[:, None], chosen.shape)[chosen]
    given = jax.device_put((drives.state, drives.control, drives.world))
    results: dict[str, Figures] = {}
    for name in MODELS:
        found = []
        for ruts in (False, True):
            weights = "any_vehicle" if described else "pretrained"
            model, params = load_model(name, weights, ruts=ruts)
            if name == "builtin":
                params = Partial(chrono_like)
            elif moves_any(model):
                params = Partial(moving, params)
            found.append(np.asarray(errors(model, params, terrain, given, driven))[chosen])
        gained = bootstrap(found[0] - found[1], drive)
        means = (float(each.mean()) for each in found)
        results[name] = dict(zip(("without ruts, m", "with ruts, m"), means, strict=True)) | {
            "less by, m": str(gained),
            "windows": int(chosen.sum()),
            "drives": len(np.unique(drive)),
        }
    return results


def cost(vehicles: int) -> dict[str, Figures]:
    """Of a step of so many vehicles on soil, with ruts and without, on one device."""
    terrain = TerrainMap.from_array(np.zeros((129, 129), np.float32), "mud")
    results: dict[str, Figures] = {}
    for name in MODELS:
        for ruts in (False, True):
            model, params = load_model(name, ruts=ruts)
            start = VehicleState.from_vector(jnp.zeros((vehicles, 12)).at[:, 2].set(0.4))
            go = Command(jnp.full((vehicles, STEPS), 3.0), jnp.full((vehicles, STEPS), 0.1))
            roll = jax.jit(jax.vmap(partial(dynamics.rollout, model), in_axes=(None, None, 0, 0)))
            timed = measure(roll, params, terrain, start, go)
            each = 1e6 * timed["median_s"] / STEPS / vehicles
            results[f"{name}, {'with' if ruts else 'without'} ruts"] = {"us a step": each}
    return results


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--data", type=Path, nargs="*", help="folders of drives")
    options.add_argument("--split", default="test", choices=["test", "unseen", "all"])
    options.add_argument("--vehicles", type=int, default=64, help="in a step that is timed")
    chosen = options.parse_args()
    report("ruts", predicted(chosen) if chosen.data else cost(chosen.vehicles), chosen.json)


if __name__ == "__main__":
    main()
