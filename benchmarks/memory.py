"""Memory of the default training, in MB: what is kept of worlds, starts and learning, and the most.

The most is the resident size of a process, compiled programs and Python included.
"""

import resource
import sys

import jax

from benchmarks._harness import parser, report
from vertiwm_jax import config as configuration
from vertiwm_jax import machine, parallel, training
from vertiwm_jax.rl import experiment
from vertiwm_jax.rl.experiment import PPOTraining
from vertiwm_jax.training import Seeds

_UNIT = 1 if sys.platform == "darwin" else 1024  # bytes, of `ru_maxrss`


def most() -> float:
    """MB that this process has had at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _UNIT / 1e6


def size(tree: object) -> float:
    """MB of the arrays of a pytree, of one copy of it."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree)) / 1e6


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--config", default="ppo", help="a configuration of PPO")
    arguments.add_argument("--iterations", type=int, default=2)
    chosen = arguments.parse_args()
    results = {"imported": {"most_MB": most()}}
    config = configuration.load(PPOTraining, configuration.default_config(chosen.config))
    terrain, pool, _ = experiment.training_ground(config)
    machine.forget_programs()
    dynamics, weights = experiment.dynamics(config, config.model)
    env = experiment.env_of(config, config.model, dynamics, config.variation)
    algorithm = Seeds(config.algorithm(env), config.loop.seeds)
    made = env.make_params(weights, terrain, pool, encoders=experiment.encoders(config))
    params = jax.block_until_ready(made)
    results["worlds and starts"] = {
        "most_MB": most(),
        "terrain_MB": size(params.terrain),
        "starts_MB": size(params.starts),
    }
    machine.forget_programs()
    state = training.begin(algorithm, params, config.key("training"))
    iterate, mesh = training.compiled(algorithm, params, state), algorithm.mesh
    results["compiled"] = {"most_MB": most()}
    params = parallel.place(mesh, params)
    state = parallel.place(mesh, state, algorithm.specs)
    machine.release_memory()
    for _ in range(chosen.iterations):
        state, _ = iterate(params, state)
    jax.block_until_ready(state)
    results["learning"] = {
        "most_MB": most(),
        "state_MB": size(state),
        "devices": mesh.size,
    }
    report("memory", results, chosen.json)


if __name__ == "__main__":
    main()
