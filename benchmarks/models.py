"""Steps of 0.1 s that each model takes in a second, by batch, on mixed ground, patches included."""

from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import jax
import jax.numpy as jnp

from benchmarks._harness import Figures, measure, parser, report
from vertiwm_jax.dynamics import Params, rollout
from vertiwm_jax.mechanics.kinematic import rest_on_ground
from vertiwm_jax.mechanics.vehicle import hmmwv
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import worlds
from vertiwm_jax.terrain.worlds import WorldConfig
from vertiwm_jax.world_model.choice import ModelName, choose

BATCHES = (1, 20, 256, 1024)
STEPS = 20


def rates(name: ModelName, weights: Path | None, batches: Sequence[int]) -> dict[str, Figures]:
    """Steps a second of one model, by batch."""
    model, params = choose(name, weights)
    terrain = worlds.generate(jax.random.split(jax.random.key(0), 1), WorldConfig())
    vehicle = hmmwv()

    def drive(params: Params, xy: jax.Array, yaw: jax.Array, commands: Command) -> jax.Array:
        position, rpy = rest_on_ground(
            terrain, xy, yaw, vehicle.wheelbase, vehicle.track, vehicle.wheel_radius
        )
        state = VehicleState(position, rpy, jnp.zeros(3), jnp.zeros(3))
        history = model.init(params, terrain, state)
        return rollout(model, params, terrain, history, state, commands).position[-1]

    results = {}
    for batch in batches:
        keys = jax.random.split(jax.random.key(1), 4)
        commands = Command(
            speed=jax.random.uniform(keys[0], (batch, STEPS), maxval=4.0),
            steering=jax.random.uniform(keys[1], (batch, STEPS), minval=-0.3, maxval=0.3),
        )
        xy = jax.random.uniform(keys[2], (batch, 2), minval=-40.0, maxval=40.0)
        yaw = jax.random.uniform(keys[3], (batch,), minval=-jnp.pi, maxval=jnp.pi)
        many = jax.jit(jax.vmap(drive, in_axes=(None, 0, 0, 0)))
        figures = measure(many, params, xy, yaw, commands, repeats=3)
        rate = batch * STEPS / figures["median_s"]
        results[f"{name}, batch {batch}"] = {"steps_per_s": rate, **figures}
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
