"""The host loop: progress, metrics and checkpoints around a compiled algorithm."""

import contextlib
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Protocol, TypeVar

import jax
import numpy as np

from vertiwm_jax.rl import checkpoints
from vertiwm_jax.runs import Run

State = TypeVar("State")


class Algorithm(Protocol[State]):
    """A learning algorithm: two pure functions, compiled whole.

    `iterate` gives scalar metrics; its `finite` says whether training can go on.
    """

    def init(self, env_params: Any, key: jax.Array) -> State: ...

    def iterate(self, env_params: Any, state: State) -> tuple[State, dict[str, jax.Array]]: ...


@dataclass(frozen=True)
class LoopConfig:
    """What is kept of a training."""

    seeds: int = 1
    """Trainings with different random keys, run side by side."""
    checkpoint_every: int = 20
    """Iterations between checkpoints."""
    keep: int = 3
    """Newest checkpoints that are kept."""

    def __post_init__(self):
        for name in ("seeds", "checkpoint_every", "keep"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, found {getattr(self, name)}")


class TrainingError(RuntimeError):
    """Training cannot go on; the message says what is left to go on from."""


class TrainingInterrupted(RuntimeError):
    """The user stopped the training; the message says where it was saved."""


def restore(
    algorithm: Algorithm[State], env_params: Any, folder: Path, seeds: int
) -> tuple[int, State] | None:
    """Iterations done and state in the newest checkpoint of the run in `folder`, if it has one.

    A checkpoint of another configuration raises `CheckpointError`.
    """
    checkpoint = checkpoints.latest(folder / "checkpoints")
    if checkpoint is None:
        return None
    keys = jax.random.split(jax.random.key(0), seeds)
    like = jax.eval_shape(jax.vmap(algorithm.init, (None, 0)), env_params, keys)
    return int(checkpoint.name), checkpoints.load(checkpoint, like)


def train(
    algorithm: Algorithm[State],
    env_params: Any,
    key: jax.Array,
    run: Run,
    iterations: int,
    transitions: int,
    config: LoopConfig,
    restored: tuple[int, State] | None = None,
) -> State:
    """Trains until `iterations` are done, from the beginning or from what `restore` gave.

    transitions: environment steps of one seed in one iteration, for rates and metrics.
    Gives the final state; every leaf has a leading axis of seeds. Metrics are means over seeds.
    Ctrl-C ends the current iteration, saves and raises `TrainingInterrupted`; a second one
    stops at once. Weights that are no longer finite raise `TrainingError`.
    """
    folder = run.folder / "checkpoints"
    if restored:
        done, state = restored
    else:
        init = jax.jit(jax.vmap(algorithm.init, (None, 0)))
        done, state = 0, init(env_params, jax.random.split(key, config.seeds))
        # Placed as a restored state is, so that both run the same program.
        state = jax.device_put(state, jax.devices()[0])
    if done >= iterations:
        return state

    print("compiling ...", flush=True)
    start = time.perf_counter()
    iterate = jax.jit(jax.vmap(algorithm.iterate, (None, 0)), donate_argnums=1)
    iterate = iterate.lower(env_params, state).compile()
    print(f"compiled in {time.perf_counter() - start:.0f} s", flush=True)

    total = (iterations - done) * transitions * config.seeds
    with _interruptible() as interrupted, run.progress(total, "training") as progress:
        while done < iterations and not interrupted:
            start = time.perf_counter()
            state, metrics = iterate(env_params, state)
            metrics = jax.device_get(metrics)
            seconds = time.perf_counter() - start
            done += 1
            if not np.all(metrics.pop("finite")):
                raise TrainingError(_diverged(done, checkpoints.latest(folder)))
            scalars = {name: _mean(value) for name, value in metrics.items()}
            scalars = {name: value for name, value in scalars.items() if value is not None}
            scalars["transitions"] = done * transitions * config.seeds
            scalars["transitions_per_second"] = transitions * config.seeds / seconds
            run.log(done, scalars)
            progress.advance(transitions * config.seeds, _note(scalars))
            if done % config.checkpoint_every == 0:
                checkpoints.save(folder, done, state, config.keep)
        if done % config.checkpoint_every:
            checkpoints.save(folder, done, state, config.keep)
    if done < iterations:
        raise TrainingInterrupted(
            f"stopped after iteration {done} of {iterations}, all saved; "
            f"go on with --resume {run.folder}"
        )
    return state


def _mean(values: np.ndarray) -> float | None:
    """Mean over the seeds that have a value; None if none has (no episode ended)."""
    values = values[~np.isnan(values)]
    return float(values.mean()) if values.size else None


def _note(scalars: dict[str, float]) -> str:
    shown = ("episode_return", "success")
    return "  ".join(f"{name} {scalars[name]:.4g}" for name in shown if name in scalars)


def _diverged(iteration: int, checkpoint: Path | None) -> str:
    left = f"the last good checkpoint is {checkpoint}" if checkpoint else "nothing was saved yet"
    return (
        f"iteration {iteration}: loss or weights are no longer finite; {left}; "
        "try a lower learning rate, and look for observations or rewards that are not finite"
    )


@contextlib.contextmanager
def _interruptible() -> Iterator[list[int]]:
    """The first Ctrl-C is noted in the list that this gives, the second acts as always."""
    seen: list[int] = []
    before = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: FrameType | None) -> None:
        seen.append(number)
        signal.signal(signal.SIGINT, before)
        print("\nstopping after this iteration; Ctrl-C again stops at once", flush=True)

    signal.signal(signal.SIGINT, note)
    try:
        yield seen
    finally:
        signal.signal(signal.SIGINT, before)
