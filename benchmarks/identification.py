"""How well `identify` recovers simulated vehicles, and whether its intervals hold.

Vehicles are drawn about the HMMWV as `identify` believes numbers to be off, their masses too, which
it is not told. Each drives a minute on a world of its own. Poses and velocities get noise.
"""

import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from operator import mul
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._harness import parser, report
from vertiwm_jax.dynamics import rollout
from vertiwm_jax.evaluation.prediction import bootstrap
from vertiwm_jax.learning import schema
from vertiwm_jax.learning.identification import MASS, PRIORS, Number, identify
from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.mechanics.simulator import Simulator, SimulatorParams, chrono_like
from vertiwm_jax.mechanics.vehicle import HMMWV, VehicleConfig, load
from vertiwm_jax.state import STEP_SECONDS, Command
from vertiwm_jax.terrain import files, worlds
from vertiwm_jax.terrain.map import TerrainMap

DRIVES, STEPS = 6, 100
NOISE = np.repeat([0.005, 0.0015, 0.01, 0.01], 3)
"""Of recorded states: m, rad, m/s and rad/s."""
TOLD = 0.1
"""Share of its prior's width that drives take away from a number of which they tell something."""


@jax.jit
@partial(jax.vmap, in_axes=(None, None, 0))
def drive(params: SimulatorParams, terrain: TerrainMap, control: jax.Array) -> jax.Array:
    """The states `[T + 1, 12]` from the middle of a world on."""
    start = place(terrain, speed=2.0)
    states = rollout(Simulator(), params, terrain, start, Command.from_vector(control))
    return jnp.concatenate([start.vector[None], states.vector])


def commands(rng: np.random.Generator) -> np.ndarray:
    """`[DRIVES, STEPS, 2]` speeds that swing and jump, and angles that swing."""
    seconds = STEP_SECONDS * np.arange(STEPS)

    def swing(highest: float) -> np.ndarray:
        turns = rng.uniform(0.05, highest, (DRIVES, 1)) * seconds + rng.uniform(size=(DRIVES, 1))
        return np.sin(2 * np.pi * turns)

    jumps = 3 * (rng.uniform(size=(DRIVES, STEPS // 20)).repeat(20, axis=1) - 0.5)
    speed = np.clip(2.5 + 2 * swing(0.4) + jumps, 0, 6)
    return np.stack([speed, 0.3 * swing(0.3)], axis=-1).astype(np.float32)


def recovered(seed: int) -> tuple[Mapping[str, float], tuple[Number, ...], np.ndarray, float]:
    """The true factors, what was found, errors before and after in m, and s that it took."""
    rng = np.random.default_rng(seed)
    given = load(HMMWV)
    true = {name: float(np.exp(d * rng.normal())) for name, d in ({"mass": MASS} | PRIORS).items()}
    numbers = {
        name: jax.tree.map(partial(mul, by), getattr(given, name)) for name, by in true.items()
    }
    terrain = worlds.make_worlds(1, seed)
    control = commands(rng)
    driven: VehicleConfig = replace(given, **numbers)
    state = np.array(drive(chrono_like(driven.vehicle), terrain, jnp.asarray(control)))
    state += NOISE * rng.normal(size=state.shape)
    with TemporaryDirectory() as folder:
        path = Path(folder)
        (path / "maps").mkdir()
        files.save(terrain, path / "maps" / "map.npz")
        wheels = driven.vehicle.wheel_position
        arrays = schema.join([schema.drive(*both) for both in zip(state, control, strict=True)])
        arrays["split"] = np.full(DRIVES, "train")
        schema.write(path / "drives.npz", arrays, {"map": "map.npz"}, wheels)
        began = time.perf_counter()
        found = identify(path, given)
        seconds = time.perf_counter() - began
    return true, found.numbers, np.array([found.before[-1], found.after[-1]]), seconds


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--vehicles", type=int, default=20)
    args = options.parse_args()
    every = [recovered(seed) for seed in range(args.vehicles)]
    results = {}
    for i, name in enumerate(PRIORS):
        of = [(true[name], numbers[i]) for true, numbers, *_ in every]
        inside = [number.low <= truth <= number.high for truth, number in of]
        width = [np.log(number.high / number.low) / 2 / np.log(number.prior) for _, number in of]
        off = [abs(np.log(number.factor / truth)) for truth, number in of]
        results[name] = {
            "within the interval": float(np.mean(inside)),
            "half-width, of the prior's": float(np.median(width)),
            "off by": float(np.median(off)),
        }
    told = [
        (vehicle, number.low <= true[number.name] <= number.high, 1 - number.told)
        for vehicle, (true, numbers, *_) in enumerate(every)
        for number in numbers
        if number.told > TOLD
    ]
    vehicle, inside, width = map(np.array, zip(*told, strict=True))
    share = bootstrap(inside, vehicle)
    results["what is told"] = {
        "within the interval": share.mean,
        "at least": share.low,
        "at most": share.high,
        "half-width, of the prior's": float(np.median(width)),
        "error before, m": float(np.mean([error[0] for *_, error, _ in every])),
        "error after, m": float(np.mean([error[1] for *_, error, _ in every])),
        "seconds": float(np.median([seconds for *_, seconds in every])),
    }
    report("identification", results, args.json)


if __name__ == "__main__":
    main()
