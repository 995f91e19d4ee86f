"""A step of Verti-WM, part by part: what it has to compute, and what that takes.

It is the shipped one, or with `--size paper` one of the paper's size, untrained.

The floor of a part is what its FLOPs, or its inputs and outputs, would take at the machine's own
ceilings, which are measured first: a matmul of 1024 x 1024, and adding a large array to another,
in place and time and again, for new memory comes several times slower.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, get_args

import jax
import jax.numpy as jnp

from benchmarks._harness import Figures, measure, parser, report
from benchmarks.models import drives, untrained
from vertiwm_jax.models.config import Size
from vertiwm_jax.models.registry import load_model
from vertiwm_jax.networks.specialist import ComputeDtype
from vertiwm_jax.perception.perceive import perceive
from vertiwm_jax.world_model import fusion, motion
from vertiwm_jax.world_model.verti_wm import VertiWM

Part = tuple[Callable[..., Any], tuple[Any, ...]]
"""A function of weights, of the map and of vehicles, over which it is vmapped, and what it gets."""
_SUMS = 16


def over_vehicles(part: Part) -> Callable[..., Any]:
    """The function compiled; weights and a map that it closed over would be its constants."""
    function, arguments = part
    return jax.jit(jax.vmap(function, (None, None, *(0 for _ in arguments[2:]))))


def parts(batch: int, size: Size) -> dict[str, Part]:
    """Every part of a step on `batch` vehicles after their first step, and the whole."""
    model, params = load_model("vertiwm") if size == "base" else untrained()
    assert isinstance(model, VertiWM)
    terrain, states, commands = drives(batch, 1)
    command = jax.tree.map(lambda x: x[:, 0], commands)

    start = jax.jit(jax.vmap(model.init, (None, None, 0)))
    begun = (params, terrain, start(params, terrain, states), states, command)
    state, history = over_vehicles((model.step, begun))(*begun)
    vehicle, seen = params.vehicle, history.features

    def look(encoders: Any, terrain: Any, state: Any) -> Any:
        return perceive(encoders, terrain, state)

    def by_transformer(weights: Any, terrain: Any, *given: Any) -> Any:
        return model.transformer.propose(weights, vehicle, terrain, *given)

    def by_nesam(weights: Any, terrain: Any, *given: Any) -> Any:
        return model.nesam.propose(weights, vehicle, terrain, *given)

    def physics(simulator: Any, terrain: Any, memory: Any, state: Any, command: Any) -> Any:
        return model.nesam.simulator.step(simulator, terrain, memory, state, command)

    def gate(
        gates: Any, _: Any, averages: Any, hidden: Any, state: Any, command: Any, *proposed: Any
    ) -> Any:
        xi_t, xi_n = (motion.increment(state, each) for each in proposed)
        nu_t, nu_n = map(motion.twist, proposed)
        motions = state, command, xi_n, xi_t
        context = fusion.context(model.gate_terrain, *averages, *motions)
        outputs, hidden = fusion.run_gates(gates, context, hidden)
        alphas = fusion.coefficients(outputs, model.coefficients)
        beta = fusion.weights(alphas.mean(axis=0))
        xi, nu = xi_t + beta * (xi_n - xi_t), nu_t + beta * (nu_n - nu_t)
        return motion.moved(state, xi, nu), hidden

    driven = (state, command)
    of_first = (params.transformer, terrain, seen[0], history.transformer, *driven)
    of_second = (params.nesam, terrain, None, history.nesam, *driven)
    proposed = [
        over_vehicles((one, arguments))(*arguments)[0]
        for one, arguments in ((by_transformer, of_first), (by_nesam, of_second))
    ]
    averages = seen[-1].average, seen[0].average
    return {
        "map query and encoders": (look, (params.encoders, terrain, state)),
        "Transformer": (by_transformer, of_first),
        "NeSAM: physics": (
            physics,
            (params.nesam.physics(vehicle), terrain, history.nesam.simulator, *driven),
        ),
        "NeSAM: physics and network": (by_nesam, of_second),
        "gate and fused motion": (
            gate,
            (params.gate, terrain, averages, history.hidden, *driven, *proposed),
        ),
        "the whole step": (model.step, (params, terrain, history, *driven)),
    }


def ceilings() -> dict[str, float]:
    """FLOP/s of matmuls and bytes/s of a sum of large arrays, on this machine, now."""
    ab = jax.random.normal(jax.random.key(0), (2, 1024, 1024))
    matmul = jax.jit(partial(jnp.matmul, preferred_element_type=jnp.float32))
    single, half = (measure(matmul, *ab.astype(dtype)) for dtype in get_args(ComputeDtype))
    x, y = jnp.ones((2, 1 << 24))
    sums = jax.jit(lambda x, y: jax.lax.fori_loop(0, _SUMS, lambda _, x: x + y, x))
    moved = 3 * _SUMS * x.nbytes
    return {
        "flops": 2 * 1024**3 / single["min_s"],
        "flops_of_bfloat16": 2 * 1024**3 / half["min_s"],
        "bytes": moved / measure(sums, x, y)["min_s"],
    }


def cost(part: Part, batch: int) -> tuple[float, float]:
    """FLOPs of one vehicle, and bytes that it reads and leaves, with its share of the weights.

    The compiler counts the operations of a loop once: those of physics are of one sub-step.
    """
    function, (weights, terrain, *arguments) = part
    alone = jax.tree.map(lambda x: x[0], arguments)
    flops = jax.jit(function).lower(weights, terrain, *alone).compile().cost_analysis()["flops"]
    results = jax.eval_shape(over_vehicles(part), weights, terrain, *arguments)
    leaves = jax.tree.leaves((weights, arguments, results))
    return flops, sum(leaf.size * leaf.dtype.itemsize for leaf in leaves) / batch


def figures(batch: int, size: Size) -> dict[str, Figures]:
    """A row for every part."""
    limits, chosen = ceilings(), parts(batch, size)
    times = {name: measure(over_vehicles(part), *part[1]) for name, part in chosen.items()}
    whole = times["the whole step"]["median_s"]
    rows: dict[str, Figures] = {
        "ceilings": {
            "GFLOP/s": limits["flops"] / 1e9,
            "GFLOP/s of bfloat16": limits["flops_of_bfloat16"] / 1e9,
            "GB/s": limits["bytes"] / 1e9,
        }
    }
    for name, part in chosen.items():
        flops, moved = cost(part, batch)
        floor = max(flops / limits["flops"], moved / limits["bytes"])
        rows[f"batch {batch}: {name}"] = {
            "kFLOP": flops / 1e3,
            "kB": moved / 1e3,
            "floor_us": 1e6 * floor,
            "measured_us": 1e6 * times[name]["median_s"] / batch,
            "share": times[name]["median_s"] / whole,
            "first_call_s": times[name]["first_call_s"],
        }
    return rows


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--batches", nargs="+", type=int, default=(1, 20, 256, 1024, 4096))
    arguments.add_argument("--size", choices=get_args(Size), default="base", help="of Verti-WM")
    chosen = arguments.parse_args()
    results: dict[str, Figures] = {}
    for batch in chosen.batches:
        results |= figures(batch, chosen.size)
    report("world_model_step", results, chosen.json)


if __name__ == "__main__":
    main()
