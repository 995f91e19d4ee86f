"""What a GPU gives, in six minutes: whether it computes what a CPU does, how fast, in what memory.

What is found is written to one JSON file after each case, so that a run that is cut off leaves
what it has. A case that fails is one line there, and in the end a status that is not 0.

One device does it, the first that JAX finds, which has to find the CPU beside it: `JAX_PLATFORMS`
is unset, or `cuda,cpu`. `--small` tries everything in tiny sizes, on a CPU too. docs/scaling.md
says how to run it where there is no network.
"""

import argparse
import contextlib
import faulthandler
import gzip
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import jaxlib
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks import operations
from benchmarks._harness import cell, hardware, measure
from benchmarks._programs import Job, Program, compiled
from benchmarks.models import drives, driving
from vertiwm_jax import atomic, runs, training
from vertiwm_jax import config as configuration
from vertiwm_jax.env.navigation import NavigationConfig, NavigationEnv
from vertiwm_jax.env.suites import GroundConfig
from vertiwm_jax.env.task import TaskParams
from vertiwm_jax.models.registry import ModelName
from vertiwm_jax.rl import experiment
from vertiwm_jax.rl.experiment import PPOTraining

Found = dict[str, Any]
Case = tuple[str, Callable[[], Found]]

STEPS = 16
"""Of a rollout, 0.1 s each."""
LONGEST = 30
"""How many operations a profile names."""
LARGEST_TRACE = 15 << 20
"""Bytes of a trace, packed, that is kept."""
TOLERANCES = {
    "default": {"median_m": 1e-2, "p99_m": 0.1, "largest_m": 0.3, "weights": 0.3, "reward": 2e-2},
    "highest": {"median_m": 1e-4, "p99_m": 5e-3, "largest_m": 0.1, "weights": 0.1, "reward": 1e-3},
}
"""By the precision of matrix products, whose operands have ten bits on a GPU by default.

Of where vehicles are after a rollout, m; of how an iteration of PPO changes weights, and of its
mean reward, relative to those of the CPU. One vehicle in hundreds touches the ground at another
moment, whatever rounds.
"""


@dataclass
class Benchmark:
    """What parts share.

    vehicles, environments: how many; output: the file; end: of the time of a part, as
        `time.monotonic` tells it.
    """

    config: PPOTraining
    models: Sequence[ModelName]
    vehicles: Sequence[int]
    environments: Sequence[int]
    output: Path
    device: jax.Device
    end: float = 0.0

    @cached_property
    def task(self) -> tuple[NavigationEnv, TaskParams]:
        """What the training learns."""
        config = self.config
        terrain, pool, _ = experiment.training_ground(config)
        return experiment.environment(config, config.model, terrain, pool, config.variation)

    def driven(self, name: ModelName, vehicles: int) -> Job:
        """Rollouts of a model."""
        drive, params = driving(name)
        return jax.vmap(drive, (None, None, 0, 0)), (params, *drives(vehicles, STEPS))

    def learned(self, environments: int, **settings: Any) -> Job:
        """An iteration of PPO inside Verti-WM, with other settings."""
        ppo = replace(self.config.ppo, num_envs=environments, **settings)
        env, task = self.task
        algorithm = training.Seeds(replace(self.config, ppo=ppo).algorithm(env), 1)
        return algorithm.iterate, (task, training.begin(algorithm, task, jax.random.key(0)))

    @cached_property
    def usual(self) -> Program:
        """An iteration of the default training."""
        return Program.of(self.learned(self.environments[0]), self.device)


def correctness(bench: Benchmark) -> Iterator[Case]:
    """Rollouts, and a short iteration of PPO, beside the same on the CPU."""
    ways: dict[str, Found] = {"cpu": {"on": jax.devices("cpu")[0]}, "default": {"on": bench.device}}
    if bench.device.platform != "cpu":
        ways["highest"] = {"on": bench.device, "precision": "highest"}

    @cache
    def job(name: ModelName | Literal["PPO"]) -> Job:
        if name != "PPO":
            return bench.driven(name, bench.vehicles[0])
        return bench.learned(bench.environments[0], num_steps=4, epochs=1)  # Roundings grow.

    def program(name: ModelName | Literal["PPO"], way: str) -> Program:
        return Program.of(job(name), **ways[way])

    names = (*bench.models, "PPO")
    programs = compiled(
        {(name, way): partial(program, name, way) for name in names for way in ways}
    )

    def compared(name: str, way: str) -> Found:
        here, there = (programs[name, of].result() for of in ("cpu", way))
        apart = learned_apart if name == "PPO" else driven_apart
        found = apart(here, jax.device_get(here()), jax.device_get(there()))
        limits = {kind: limit for kind, limit in TOLERANCES[way].items() if kind in found}
        beyond = [kind for kind, limit in limits.items() if not found[kind] <= limit]  # or NaN
        error = {"error": f"beyond tolerance: {', '.join(beyond)}"} if beyond else {}
        return found | {"tolerances": limits} | error

    for name in names:
        for way in list(ways)[1:]:
            yield f"{name}, {way} precision", partial(compared, name, way)


def driven_apart(_: Program, expected: Any, found: Any) -> Found:
    """How far vehicles are apart in the end, and at most."""
    meters = np.linalg.norm(found.position - expected.position, axis=-1)
    turns = np.angle(np.exp(1j * (found.rpy - expected.rpy)))
    return {
        "median_m": float(np.median(meters[:, -1])),
        "p99_m": float(np.quantile(meters[:, -1], 0.99)),
        "largest_m": float(np.max(meters)),
        "largest_deg": float(np.rad2deg(np.max(np.abs(turns)))),
    }


def learned_apart(program: Program, expected: Any, found: Any) -> Found:
    """How far changes of weights, and metrics, are apart, relative to what is expected."""
    states = (jax.device_get(program.given[1]), expected[0], found[0])
    before, after, other = (np.asarray(ravel_pytree(state.params)[0]) for state in states)
    relative = {"weights": float(np.linalg.norm(other - after) / np.linalg.norm(after - before))}
    for name in ("reward", "value_loss", "entropy"):
        here, there = (float(np.mean(metrics[name])) for _, metrics in (expected, found))
        relative[name] = abs(there - here) / abs(here)
    return relative


def ppo(bench: Benchmark) -> Iterator[Case]:
    """Transitions a second of PPO inside Verti-WM, update included, by environments."""
    usual, *others = bench.environments

    def larger(number: int) -> Program:
        return Program.of(bench.learned(number), bench.device)

    programs = compiled(
        {usual: lambda: bench.usual, **{number: partial(larger, number) for number in others}}
    )
    wait(programs.values())  # Nothing else is to be done while something is timed.
    for number, program in programs.items():
        done = number * bench.config.ppo.num_steps * bench.config.action_repeat
        yield f"{number} environments", partial(rate, program, done, "transitions_per_s")


def steps(bench: Benchmark) -> Iterator[Case]:
    """Steps of 0.1 s a second of each model, by vehicles."""

    def of_model(name: ModelName, vehicles: int) -> Program:
        return Program.of(bench.driven(name, vehicles), bench.device)

    for vehicles in reversed(bench.vehicles):  # Large batches tell most.
        programs = compiled({name: partial(of_model, name, vehicles) for name in bench.models})
        wait(programs.values())
        for name, program in programs.items():
            measured = partial(rate, program, vehicles * STEPS, "steps_per_s")
            yield f"{name}, {vehicles} vehicles", measured


def rate(future: Future[Program], done: int, unit: str) -> Found:
    """How fast a program does so much, and the most memory that all so far have had at a time."""
    program = future.result()
    times = measure(program, repeats=3)
    times["first_run_s"] = times.pop("first_call_s")  # It is compiled already.
    memory = program.on.memory_stats()
    peak = {"peak_GB": memory["peak_bytes_in_use"] / 1e9} if memory else {}
    fast = {unit: done / times["median_s"], f"most_{unit}": done / times["min_s"]}
    return fast | peak | times | program.found


def profile(bench: Benchmark) -> Iterator[Case]:
    """The longest operations of an iteration of PPO."""
    yield "PPO", partial(longest, bench)


def longest(bench: Benchmark) -> Found:
    """Of the default training; the trace, packed, lies beside the output."""
    iterate = bench.usual
    iterate()
    options = jax.profiler.ProfileOptions()
    options.python_tracer_level = 0
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder, profiler_options=options):
            start = time.monotonic()
            iterate()
            seconds = time.monotonic() - start
        (file,) = Path(folder).rglob("*.xplane.pb")
        spent, trace = operations.by_name(file), gzip.compress(file.read_bytes())
    known = operations.named(iterate.compiled.as_text())
    known = {name.replace(".", "_"): row for name, row in known.items()}  # as kernels are named
    rows = {name: (*row, *known.get(name.replace(".", "_"), ())) for name, row in spent.items()}
    if bench.device.platform == "cpu":  # whose trace has other calls, too
        rows = {name: row for name, row in rows.items() if len(row) > 2}
    top = sorted(rows.items(), key=lambda row: -row[1][0])[:LONGEST]
    kept = bench.output.with_suffix(".xplane.pb.gz")
    if len(trace) <= LARGEST_TRACE:
        kept.write_bytes(trace)
    columns = ("ns", "calls", "shape", "of")
    return {
        "iteration_s": seconds,
        "operations_s": sum(row[0] for row in rows.values()) / 1e9,
        "operations": sum(row[1] for row in rows.values()),
        "trace": kept.name if len(trace) <= LARGEST_TRACE else f"{len(trace)} bytes, not kept",
        "longest": {name: dict(zip(columns, row, strict=False)) for name, row in top},
    }


def end_to_end(bench: Benchmark) -> Iterator[Case]:
    """The default training, from its command to its table, then again with the programs it kept."""
    with tempfile.TemporaryDirectory() as kept:
        yield "python -m vertiwm_jax.ppo", partial(trained, bench, Path(kept))
        yield "with programs kept", partial(trained, bench, Path(kept))


def trained(bench: Benchmark, kept: Path) -> Found:
    """In a process of its own that keeps compiled programs in a folder, and when it said what."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "ppo.yaml"
        configuration.save(replace(bench.config, compute_dtype="auto", runs=Path(folder)), file)
        command = [sys.executable, "-m", "vertiwm_jax.ppo", "--config", str(file)]
        # This process has three quarters of the device's memory.
        given = os.environ | {"XLA_PYTHON_CLIENT_MEM_FRACTION": "0.2"}
        given["JAX_COMPILATION_CACHE_DIR"] = str(kept)
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        start = time.monotonic()
        with subprocess.Popen(command, env=given, text=True, **pipes) as process:
            limit = threading.Timer(bench.end - start, process.kill)
            limit.start()
            lines = process.stdout or ()
            said = [(round(time.monotonic() - start, 1), line.rstrip()) for line in lines]
            limit.cancel()
        found: Found = {"all_s": time.monotonic() - start, "said": said}
        for run in Path(folder).glob("ppo-*"):
            if rates := runs.read_columns(run).get("timesteps_per_second"):
                found["median_transitions_per_s"] = statistics.median(rates)
    error = {"error": f"ended with status {process.returncode}"} if process.returncode else {}
    return found | error


def compiling(bench: Benchmark) -> Iterator[Case]:
    """What tracing, lowering and compiling the main programs take, one after the other."""
    jobs: dict[str, Callable[[], Job]] = {
        "PPO": partial(bench.learned, bench.environments[0]),
        **{name: partial(bench.driven, name, bench.vehicles[0]) for name in bench.models},
    }

    def anew(make: Callable[[], Job]) -> Found:
        job = make()
        jax.clear_caches()  # so that all is traced
        return Program.of(job, bench.device).compile().found

    for name, make in jobs.items():
        yield name, partial(anew, make)


PARTS: dict[str, tuple[Callable[[Benchmark], Iterator[Case]], int]] = {
    "correctness": (correctness, 25),
    "ppo": (ppo, 22),
    "profile": (profile, 3),
    "training": (end_to_end, 42),
    "steps": (steps, 7),
    "compile": (compiling, 1),
}
"""In their order, and the percent of the time in which they begin cases; what is left goes on."""


def run(bench: Benchmark, parts: Sequence[str], seconds: float, found: Found) -> list[str]:
    """Runs parts, writes what each case finds, and gives the names of those that failed."""
    start, share, failed = time.monotonic(), 0, []

    def write() -> None:
        found["seconds"] = time.monotonic() - start
        atomic.write(bench.output, json.dumps(found, indent=1) + "\n")

    for name in parts:
        make, percent = PARTS[name]
        share += percent
        bench.end = start + seconds * share / sum(PARTS[name][1] for name in parts)
        begun, cases = time.monotonic(), make(bench)
        part: Found = {"seconds": 0.0, "cases": {}}
        found[name] = part
        while time.monotonic() < bench.end:
            case = attempted(partial(next, cases, None))
            if case is None:
                break
            prepared = not isinstance(case, dict)
            title, figures = (case[0], attempted(case[1])) if prepared else ("preparing", case)
            part["cases"][title], part["seconds"] = figures, time.monotonic() - begun
            if "error" in figures:
                failed.append(f"{name}, {title}")
            write()
            shown = (f"{key} {cell(x)}" for key, x in figures.items() if isinstance(x, float | str))
            print(f"{found['seconds']:4.0f} s  {name}, {title}: {', '.join(shown)}", flush=True)
        else:
            part["out_of_time"] = True
    write()
    return failed


def attempted(task: Callable[[], Any]) -> Any:
    """What a task gives, or its error in one line."""
    try:
        return task()
    except Exception as error:
        return {"error": f"{type(error).__name__}: {error}".splitlines()[0][:300]}


def machine(device: jax.Device) -> Found:
    """What it is measured on."""
    found: Found = hardware() | {"jaxlib": jaxlib.__version__}
    found["platform"] = device.client.platform_version
    found["precision"] = jax.config.jax_default_matmul_precision or "default"
    found["memory_GB"] = (device.memory_stats() or {}).get("bytes_limit", 0) / 1e9
    commands = {
        "driver": "nvidia-smi --query-gpu=driver_version --format=csv,noheader",
        "commit": "git rev-parse HEAD",
    }
    for name, command in commands.items():
        with contextlib.suppress(OSError):
            said = subprocess.run(command.split(), text=True, capture_output=True)
            found[name] = said.stdout.strip()
    return found


def sizes(small: bool) -> tuple[PPOTraining, Sequence[ModelName], Sequence[int], Sequence[int]]:
    """The training, models, and numbers of vehicles and of environments."""
    config = configuration.load(PPOTraining, configuration.default_config("ppo"))
    config = replace(config, compute_dtype="float32")
    if not small:
        numbers = (256, 1024, 4096, 16_384)
        return config, get_args(ModelName), (*numbers, 65_536), numbers
    tiny = replace(
        config,
        model="transformer",  # of those that have learned, what compiles fastest
        ground=GroundConfig(train_worlds=2, suites=("easy",), suite_worlds=1, starts=8, pairs=1),
        navigation=NavigationConfig(horizon_seconds=2, settle_steps=2),
        action_repeat=2,
        ppo=replace(config.ppo, total_timesteps=64, num_envs=8, num_steps=4, minibatches=2),
    )
    return tiny, ("builtin", "transformer"), (8,), (8, 16)


def main() -> None:
    arguments = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    arguments.add_argument("--output", type=Path, default=Path("runs/gpu/gpu.json"))
    arguments.add_argument("--minutes", type=float, default=6.0, help="in which cases begin")
    arguments.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    arguments.add_argument("--small", action="store_true", help="tiny sizes, to try it")
    chosen = arguments.parse_args()
    # Compilers can hang. What was found until then is written.
    faulthandler.dump_traceback_later(1.25 * 60 * chosen.minutes, exit=True)
    jax.config.update("jax_enable_compilation_cache", False)
    chosen.output.parent.mkdir(parents=True, exist_ok=True)
    bench = Benchmark(*sizes(chosen.small), chosen.output, jax.devices()[0])
    failed = run(bench, chosen.parts, 60 * chosen.minutes, {"machine": machine(bench.device)})
    print(f"written to {chosen.output}")
    if failed:
        sys.exit(f"error: {len(failed)} failed: {'; '.join(failed)}")


if __name__ == "__main__":
    main()
