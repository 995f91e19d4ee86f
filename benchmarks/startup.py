"""Seconds from the start of a training to its first iteration, without and with compiled programs.

Each start is a process of its own; the second finds the programs that the first has compiled. Of
every phase it also says what JAX traced and lowered, in Python, and what XLA compiled, or read.
"""

import json
import os
import subprocess
import sys
import tempfile
import time

from benchmarks._harness import Figures, parser, report

_EVENTS = {
    "/jax/core/compile/jaxpr_trace_duration": "tracing_s",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lowering_s",
    "/jax/core/compile/backend_compile_duration": "compiling_s",
}
_LAST = "first iteration"


def phases(name: str) -> dict[str, dict[str, float]]:
    """Seconds of each phase of the start of the training that the configuration describes."""
    found, start = {}, time.perf_counter()
    spent = dict.fromkeys(_EVENTS.values(), 0.0)

    def note(event: str, duration: float, **_: object) -> None:
        if event in _EVENTS:
            spent[_EVENTS[event]] += duration

    def lap(phase: str) -> None:
        nonlocal start
        now = time.perf_counter()
        found[phase] = {"all_s": now - start, **spent}
        start = now
        spent.update(dict.fromkeys(spent, 0.0))

    import jax

    jax.monitoring.register_event_duration_secs_listener(note)
    from vertiwm_jax import config as configuration
    from vertiwm_jax import machine, parallel, training, xla
    from vertiwm_jax.rl import experiment
    from vertiwm_jax.rl.experiment import PPOTraining
    from vertiwm_jax.training import Seeds

    lap("import")
    xla.keep_compiled()  # in the folder of the environment
    config = configuration.load(PPOTraining, configuration.default_config(name))
    terrain, pool, _ = jax.block_until_ready(experiment.training_ground(config))
    machine.forget_programs()
    lap("worlds")
    dynamics, weights = experiment.dynamics(config, config.model)
    env = experiment.env_of(config, config.model, dynamics, config.variation)
    algorithm = Seeds(config.algorithm(env), config.loop.seeds)
    made = env.make_params(weights, terrain, pool, encoders=experiment.encoders(config))
    params = jax.block_until_ready(made)
    machine.forget_programs()
    lap("starts")
    state = jax.block_until_ready(training.begin(algorithm, params, config.key("training")))
    lap("weights")
    iterate = training.compiled(algorithm, params, state)
    params = parallel.place(algorithm.mesh, params)
    state = parallel.place(algorithm.mesh, state, algorithm.specs)
    lap("compile")
    jax.block_until_ready(iterate(params, state))
    lap(_LAST)
    return found


def in_a_process(name: str, compiled: str) -> dict[str, Figures]:
    """`phases` in a new process that keeps compiled programs in a folder, and their sum."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": compiled}
    command = [sys.executable, "-m", "benchmarks.startup", "--phases", "--config", name]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    found = json.loads(done.stdout.splitlines()[-1])
    before = [found[phase] for phase in found if phase != _LAST]
    total = {part: sum(phase[part] for phase in before) for part in found[_LAST]}
    return {f"until the {_LAST}": total, **found}


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
        results = {
            f"{case}: {phase}": figures
            for case in cases
            for phase, figures in in_a_process(chosen.config, compiled).items()
        }
    report("startup", results, chosen.json)


if __name__ == "__main__":
    main()
