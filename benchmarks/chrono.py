"""Steps of 0.1 s that Project Chrono takes in a second in one process, and Verti-WM beside it."""

import time
from typing import get_args

import jax
import numpy as np

from benchmarks._harness import Figures, parser, report
from benchmarks.models import rates
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.simulators import excitation
from vertiwm_jax.simulators.chrono import Chrono
from vertiwm_jax.terrain import worlds
from vertiwm_jax.terrain.worlds import Kind, WorldConfig

VEHICLES = 256


def driven(kind: Kind, drives: int, steps: int) -> dict[str, float | int]:
    """Rates of an HMMWV under the paper's commands, on a world of its own in each drive."""
    config, lock = (
        WorldConfig(difficulties=("mid",), kinds=(kind,)),
        float(load_vehicle().steering_limit),
    )
    terrain = worlds.generate(jax.random.split(jax.random.key(0), drives), config)
    starting, stepping = [], []
    for number in range(drives):
        rng, world = np.random.default_rng(number), terrain.select(number)
        simulator, pilot = Chrono(world), excitation.sinusoids(rng, steps, lock)
        start = excitation.start(rng, world, 0.1 * steps)
        began = time.perf_counter()
        state = simulator.start(*start).state
        ready = time.perf_counter()
        for _ in range(steps):
            state = simulator.step(pilot(state)).state
        starting.append(ready - began)
        stepping.append(time.perf_counter() - ready)
    rate = steps / float(np.median(stepping))
    return {"steps_per_s": rate, "start_s": float(np.median(starting)), "drives": drives}


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--drives", type=int, default=5, help="on each kind of ground")
    arguments.add_argument("--steps", type=int, default=100, help="of a drive")
    chosen = arguments.parse_args()
    results: dict[str, Figures] = {
        f"Chrono, {kind}": driven(kind, chosen.drives, chosen.steps) for kind in get_args(Kind)
    }
    results |= rates("vertiwm", None, [VEHICLES])
    report("chrono", results, chosen.json)


if __name__ == "__main__":
    main()
