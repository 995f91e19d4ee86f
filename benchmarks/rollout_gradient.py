"""16 predicted steps of each learned model, and their gradient to weights and commands."""

import jax
import jax.numpy as jnp

from benchmarks._harness import Figures, measure, parser, report
from benchmarks.models import drives
from vertiwm_jax.dynamics import Params, rollout
from vertiwm_jax.models.registry import ModelName, load_model
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap

BATCHES = (1, 64)
STEPS = 16


def rates(name: ModelName, batches: tuple[int, ...]) -> dict[str, Figures]:
    """Seconds of a rollout, and of a rollout with its gradient, by batch."""
    model, params = load_model(name)

    def traveled(
        params: Params, commands: Command, terrain: TerrainMap, starts: VehicleState
    ) -> jax.Array:
        def one(start: VehicleState, command: Command) -> jax.Array:
            history = model.init(params, terrain, start)
            end = rollout(model, params, terrain, start, command, history).position[-1]
            return jnp.sum((end - start.position) ** 2)

        return jnp.mean(jax.vmap(one)(starts, commands))

    results = {}
    for batch in batches:
        terrain, starts, commands = drives(batch, STEPS)
        given = params, commands, terrain, starts
        forward = measure(jax.jit(traveled), *given, repeats=3)
        gradient = jax.jit(jax.grad(traveled, argnums=(0, 1), allow_int=True))
        both = measure(gradient, *given, repeats=3)
        results[f"{name}, batch {batch}"] = {
            "forward_s": forward["median_s"],
            "with_gradient_s": both["median_s"],
            "times": both["median_s"] / forward["median_s"],
            "first_call_s": both["first_call_s"],
        }
    return results


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--models", nargs="+", default=("transformer", "nesam", "vertiwm"))
    arguments.add_argument("--batches", nargs="+", type=int, default=BATCHES)
    chosen = arguments.parse_args()
    results: dict[str, Figures] = {}
    for name in chosen.models:
        results |= rates(name, chosen.batches)
    report("rollout_gradient", results, chosen.json)


if __name__ == "__main__":
    main()
