"""Wheel-force evaluations a second: floor 2 million on two cores."""

import jax
import jax.numpy as jnp

from benchmarks._harness import measure, parser, report
from vertiwm_jax.mechanics.bekker_wong import BekkerWongParams
from vertiwm_jax.mechanics.equilibrium import equilibrium_sinkage
from vertiwm_jax.mechanics.wheel import Wheel
from vertiwm_jax.terrain.soil import PRESETS, stack


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--wheels", type=int, default=65_536, help="wheels in a batch")
    options = arguments.parse_args()

    uniform = jax.random.uniform(jax.random.key(0), (5, options.wheels))
    soils = stack([PRESETS[name] for name in ("mud", "sand", "snow")])
    soil = jax.tree.map(lambda x: x[(uniform[0] * 3).astype(int)], soils)
    wheel, contact = Wheel(jnp.float32(0.467), jnp.float32(0.254)), BekkerWongParams()
    sinkage, velocity_x = 0.1 * uniform[1], 5 * uniform[2]
    motion = velocity_x, uniform[3] - 0.5, 12 * uniform[4]
    load = 6000 * jnp.ones_like(sinkage)

    def forces(wheel, soil, contact, sinkage, motion):
        return contact.forces(wheel, soil, sinkage, motion)

    def total(*arguments):
        return sum(jnp.sum(x) for x in jax.tree.leaves(forces(*arguments)))

    cases = {
        "forces": (forces, (sinkage, motion)),
        "forces and gradient": (jax.value_and_grad(total, argnums=(1, 3, 4)), (sinkage, motion)),
        "equilibrium sinkage": (equilibrium_sinkage, (load, motion)),
    }
    results = {}
    for name, (function, inputs) in cases.items():
        figures = measure(jax.jit(function), wheel, soil, contact, *inputs)
        rate = options.wheels / figures["median_s"]
        results[name] = {"wheels": options.wheels, "wheels_per_s": rate, **figures}
    report("wheel_forces", results, options.json)


if __name__ == "__main__":
    main()
