"""Seconds from the start of a training to its first iteration, without and with compiled programs.

Each start is a process of its own; the second finds the programs that the first has compiled.
"""

import json
import os
import subprocess
import sys
import tempfile
import time

from benchmarks._harness import Figures, parser, report


def phases(name: str) -> dict[str, float]:
    """Seconds of each phase of the start of the training that the configuration describes."""
    seconds, start = {}, time.perf_counter()

    def lap(phase: str) -> None:
        nonlocal start
        seconds[phase], start = time.perf_counter() - start, time.perf_counter()

    import jax

    from vertiwm_jax import config as configuration
    from vertiwm_jax import devices, training
    from vertiwm_jax.env.navigation import NavigationEnv
    from vertiwm_jax.ppo import PPOTraining
    from vertiwm_jax.rl import task
    from vertiwm_jax.rl.loop import Seeds

    lap("import_s")
    training.keep_compiled(None)  # in the folder of the environment
    config = configuration.load(PPOTraining, configuration.default_config(name))
    terrain, pool, _ = jax.block_until_ready(task.training_ground(config))
    devices.forget_programs()
    lap("worlds_s")
    dynamics, weights = task.dynamics(config, config.model)
    env = NavigationEnv(dynamics, config.asked, config.variation)
    algorithm, batch = Seeds(config.algorithm(env), config.loop.seeds), config.ppo.shareable
    training.compiled(algorithm, env.shapes(weights, terrain, pool), batch)
    lap("compile_s")
    params = jax.block_until_ready(env.make_params(weights, terrain, pool))
    devices.forget_programs()
    lap("starts_s")
    state = training.begin(algorithm, params, config.key("training"))
    iterate = training.compiled(algorithm, params, batch)
    params, state = devices.everywhere(devices.mesh(batch), (params, state))
    lap("weights_s")
    jax.block_until_ready(iterate(params, state))
    lap("first_iteration_s")
    return seconds


def in_a_process(name: str, compiled: str) -> Figures:
    """`phases` in a new process that keeps compiled programs in a folder."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": compiled}
    command = [sys.executable, "-m", "benchmarks.startup", "--phases", "--config", name]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    found = json.loads(done.stdout.splitlines()[-1])
    return {"until_first_iteration_s": sum(found.values()) - found["first_iteration_s"], **found}


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--config", default="ppo", help="a configuration of PPO")
    arguments.add_argument("--phases", action="store_true", help="one start, in this process")
    chosen = arguments.parse_args()
    if chosen.phases:
        print(json.dumps(phases(chosen.config)))
        return
    with tempfile.TemporaryDirectory() as compiled:
        cases = ("nothing compiled before", "everything compiled before")
        results = {case: in_a_process(chosen.config, compiled) for case in cases}
    report("startup", results, chosen.json)


if __name__ == "__main__":
    main()
