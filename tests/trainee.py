"""RUNS|RUN ITERATIONS [SIGNAL]: a training of PPO that costs little to compile, as a command.

It begins in the folder RUNS, or goes on with RUN. The last of several hosts sends itself SIGNAL
after the third iteration.
"""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import jax
from rl.probes import ProbeParams, Target

from vertiwm_jax import cli
from vertiwm_jax.rl.ppo import PPO, PPOConfig
from vertiwm_jax.runs import Run
from vertiwm_jax.training import LoopConfig, Seeds, Work, restore, train

STOPPED = 3
"""Iterations until the signal."""
CONFIG = PPOConfig(
    num_envs=16, num_steps=16, minibatches=4, epochs=2, hidden=(8,), schedule="constant"
)


@dataclass(frozen=True)
class Settings:
    runs: Path
    resume: Path | None
    loop: LoopConfig = LoopConfig(checkpoint_every=2)


def trained(folder: Path, iterations: int) -> Path:
    """The run folder of a training that begins in `folder`, or that is there and goes on."""
    algorithm, data = PPO(Target(), CONFIG), ProbeParams()
    resume = folder if (folder / "checkpoints").is_dir() else None
    settings = Settings(folder, resume)
    seeds = Seeds(algorithm, settings.loop.seeds)
    restored = restore(seeds, data, resume) if resume else None
    with Run.begin(settings, "probe", restored[0] if restored else 0) as run:
        key, work = jax.random.key(0), Work("timesteps", algorithm.timesteps, ())
        train(seeds, data, key, run, iterations, work, settings.loop, restored)
    return run.folder


def stop_by(number: int) -> None:
    log = Run.log

    def stopping(self, step, metrics):
        log(self, step, metrics)
        if step == STOPPED:
            os.kill(os.getpid(), number)

    Run.log = stopping


def main() -> None:
    if sys.argv[3:] and jax.process_index() == jax.process_count() - 1:
        stop_by(int(sys.argv[3]))
    with cli.failures_in_one_line("ppo"), cli.told():
        print(trained(Path(sys.argv[1]), int(sys.argv[2])))
