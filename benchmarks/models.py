"""Steps of 0.1 s that each model takes in a second, by batch, on mixed ground, patches included.

On as many devices as `vertiwm_jax.parallel.mesh` gives a batch: every core of a CPU is one, unless
`JAX_NUM_CPU_DEVICES` sets another number.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import get_args

import jax
import jax.numpy as jnp

from benchmarks._harness import Figures, measure, parser, report
from vertiwm_jax import parallel
from vertiwm_jax.dynamics import Params, rollout
from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.models.config import ModelConfig, with_soil
from vertiwm_jax.models.registry import ModelName, load_model
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import worlds
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.worlds import WorldConfig
from vertiwm_jax.world_model.verti_wm import VertiWM, VertiWMParams

BATCHES = (1, 20, 256, 1024)
STEPS = 20
PAPER = ModelConfig(size="paper")


def drives(batch: int, steps: int) -> tuple[TerrainMap, VehicleState, Command]:
    """A mixed world, vehicles at rest on it, leaves `[B, 3]`, and commands, leaves `[B, T]`."""
    terrain = worlds.generate(jax.random.split(jax.random.key(0), 1), WorldConfig())
    keys = jax.random.split(jax.random.key(1), 4)
    commands = Command(
        speed=jax.random.uniform(keys[0], (batch, steps), maxval=4.0),
        steering=jax.random.uniform(keys[1], (batch, steps), minval=-0.3, maxval=0.3),
    )
    xy = jax.random.uniform(keys[2], (batch, 2), minval=-40.0, maxval=40.0)
    yaw = jax.random.uniform(keys[3], (batch,), minval=-jnp.pi, maxval=jnp.pi)
    return terrain, jax.jit(jax.vmap(partial(place, terrain)))(xy, yaw), commands


def untrained() -> tuple[VertiWM, VertiWMParams]:
    """A Verti-WM of the paper's size with random weights, for none is shipped."""
    params = PAPER.init_params(jax.random.key(0), chrono_like(load_vehicle()))
    return PAPER.verti_wm, with_soil(params, None)


def driving(
    name: ModelName, weights: Path | None = None
) -> tuple[Callable[..., VehicleState], Params]:
    """Where one model drives, leaves `[T, 3]`, as a function; and its parameters."""
    model, params = load_model(name, weights)

    def drive(
        params: Params, terrain: TerrainMap, start: VehicleState, commands: Command
    ) -> VehicleState:
        history = model.init(params, terrain, start)
        return rollout(model, params, terrain, start, commands, history)

    return drive, params


def rates(name: ModelName, weights: Path | None, batches: Sequence[int]) -> dict[str, Figures]:
    """Steps a second of one model, by batch."""
    drive, params = driving(name, weights)
    many = jax.jit(parallel.vmap(drive, in_axes=(None, None, 0, 0)))
    results = {}
    for batch in batches:
        mesh = parallel.mesh(batch)
        given = parallel.place(mesh, (params, *drives(batch, STEPS)))
        with jax.set_mesh(mesh):
            figures = measure(many, *given, repeats=3)
        rate = batch * STEPS / figures["median_s"]
        results[f"{name}, batch {batch}"] = {"steps_per_s": rate, **figures, "devices": mesh.size}
    return results


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--models", nargs="+", default=get_args(ModelName))
    arguments.add_argument("--weights", type=Path, help="folder of a fitted model, e.g. RUN/model")
    arguments.add_argument("--batches", nargs="+", type=int, default=BATCHES)
    chosen = arguments.parse_args()
    results: dict[str, Figures] = {}
    for name in chosen.models:
        results |= rates(name, chosen.weights, chosen.batches)
    report("models", results, chosen.json)


if __name__ == "__main__":
    main()
