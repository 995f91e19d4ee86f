"""The host loop of training: progress, metrics and checkpoints around a compiled algorithm."""

import contextlib
import logging
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from types import FrameType
from typing import Any, ClassVar, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh

from vertiwm_jax import checkpoints, hosts, kept, machine, parallel
from vertiwm_jax.config import Count, settings
from vertiwm_jax.errors import TrainingInterrupted, UserError
from vertiwm_jax.runs import Progress, Run

State = TypeVar("State")
_log = logging.getLogger(__name__)

NONE = float("inf")
"""A metric without a value; NaN would stop those who search for NaN (`jax_debug_nans`)."""


class Algorithm(ABC, Generic[State]):
    """A learning algorithm: two pure functions, compiled whole; `data` is what it learns from.

    specs: how devices share out the leaves of the state; every device has all by default.
    """

    specs: ClassVar[Any] = parallel.WHOLE

    @property
    def batch(self) -> int:
        """What divides the sizes of all batches that devices share; 1 for none."""
        return 1

    @property
    def mesh(self) -> Mesh:
        """The devices that it is worth while to use."""
        return parallel.mesh(self.batch)

    @abstractmethod
    def init(self, data: Any, key: jax.Array) -> State:
        """The state before the first iteration."""

    @abstractmethod
    def iterate(self, data: Any, state: State) -> tuple[State, dict[str, jax.Array]]:
        """The state after an iteration, and scalar metrics, or arrays whose mean is reported.

        NaN and `NONE` are no values. `finite` says whether training can go on.
        """


@dataclass(frozen=True)
class Seeds(Algorithm[State]):
    """An algorithm with several random keys; every leaf of its state has an axis of seeds."""

    algorithm: Algorithm[State]
    seeds: int

    @property
    def specs(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return parallel.with_axis(parallel.SEEDS, self.algorithm.specs)

    @property
    def mesh(self) -> Mesh:
        return parallel.mesh(self.algorithm.batch, self.seeds)

    def init(self, data: Any, key: jax.Array) -> State:
        keys = jax.random.split(key, self.seeds)
        # One after the other: batched QR decompositions, of which orthogonal weights are made, wait
        # for each other for ever on a CPU of few cores (jaxlib 0.10).
        return jax.lax.map(partial(self.algorithm.init, data), keys)

    def iterate(self, data: Any, state: State) -> tuple[State, dict[str, jax.Array]]:
        if self.seeds == 1:  # an axis of one makes XLA compile slower sums
            alone = jax.tree.map(lambda x: x[0], state)
            return jax.tree.map(lambda x: x[None], self.algorithm.iterate(data, alone))
        iterate = jax.vmap(self.algorithm.iterate, (None, 0), spmd_axis_name=parallel.SEEDS)
        return iterate(data, state)


@settings
class CheckpointConfig:
    """What is kept of a training."""

    checkpoint_every: Count = 20
    """Iterations between checkpoints."""
    keep: Count = 3
    """Newest checkpoints that are kept."""


@settings
class LoopConfig(CheckpointConfig):
    """What is kept of a training, and how often it is done."""

    seeds: Count = 1
    """Trainings with different random keys, run side by side."""


@dataclass(frozen=True)
class Work:
    """What an iteration gets done, for rates and metrics, and which metrics the progress shows."""

    unit: str
    amount: int
    shown: tuple[str, ...]


class TrainingError(UserError):
    """Training cannot go on; the message says what is left to go on from."""


def mean_in_turns(function: Callable[[Any], State], batches: Any) -> State:
    """Mean of what the function gives for each of several batches, with one at a time in memory.

    batches: pytree with leaves `[K, ...]`. Of gradients this is what gives that of all K together.
    """
    number = len(jax.tree.leaves(batches)[0])
    first = jax.tree.map(lambda x: x[0], batches)
    if number == 1:
        return function(first)
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(function, first))
    total, _ = jax.lax.scan(
        lambda total, batch: (jax.tree.map(jnp.add, total, function(batch)), None), nothing, batches
    )
    return jax.tree.map(lambda x: x / number, total)


def all_finite(tree: Any) -> jax.Array:
    """`[]` whether all numbers of a pytree are finite."""
    # As one vector, or XLA would compile the same for each leaf.
    return jnp.all(jnp.isfinite(ravel_pytree(tree)[0]))


def restore(algorithm: Algorithm[State], data: Any, folder: Path) -> tuple[int, State] | None:
    """Iterations done and state in the newest checkpoint of the run in `folder`, if it has one.

    A checkpoint of another configuration raises `CheckpointError`.
    """
    checkpoint = checkpoints.latest(folder / "checkpoints")
    if checkpoint is None:
        return None
    like = jax.eval_shape(algorithm.init, data, jax.random.key(0))
    return int(checkpoint.name), checkpoints.load(checkpoint, like)


def compiled(algorithm: Algorithm[State], data: Any, state: State) -> Any:
    """`iterate` as a program for the devices of `algorithm.mesh`; the last one is kept.

    Trainings that are alike, like those of gates, have one program.
    """
    # Shapes also of Python's numbers, which parameters of gymnax's environments have.
    leaves, kind = jax.tree.flatten(jax.eval_shape(lambda *given: given, data, state))
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
    return _compiled(algorithm, algorithm.mesh, kind, shapes)


@partial(
    kept.jit,
    static_argnames="algorithm",
    compiler_options={"xla_backend_optimization_level": 0},
)
def begin(algorithm: Algorithm[State], data: Any, key: jax.Array) -> State:
    """The state before the first iteration."""
    return algorithm.init(data, key)


def train(
    algorithm: Algorithm[State],
    data: Any,
    key: jax.Array,
    run: Run,
    iterations: int,
    work: Work,
    config: CheckpointConfig,
    restored: tuple[int, State] | None = None,
    saved: Callable[[State], None] = lambda state: None,
) -> State:
    """Trains until `iterations` are done, from the beginning or from what `restore` gave.

    Gives the final state; `saved` gets each state of which a checkpoint was written. Ctrl-C or
    SIGTERM, on any host, ends the current iteration, saves and raises `TrainingInterrupted`; a
    second one stops at once. `TrainingError` when an iteration says that it is not finite.
    """
    folder = run.folder / "checkpoints"
    if restored:
        done, state = restored
    else:
        done, state = 0, begin(algorithm, data, key)
    if done >= iterations:
        return state

    iterate, mesh = compiled(algorithm, data, state), algorithm.mesh
    data = parallel.place(mesh, data)
    state = parallel.place(mesh, state, algorithm.specs)
    machine.release_memory()
    total = (iterations - done) * work.amount

    def save() -> None:
        # Whole arrays, so that checkpoints do not know of devices.
        whole = parallel.gather(mesh, state)
        checkpoints.save(folder, done, whole, config.keep)
        saved(whole)

    with _interruptible() as interrupted, Progress(total, "training") as progress:
        while done < iterations and not hosts.on_any(bool(interrupted)):
            start = time.perf_counter()
            state, metrics = iterate(data, state)
            metrics = jax.device_get(metrics)
            seconds = time.perf_counter() - start
            done += 1
            if not np.all(metrics.pop("finite")):
                last = checkpoints.latest(folder)
                left = f"the last good checkpoint is {last}" if last else "nothing was saved yet"
                raise TrainingError(
                    f"iteration {done}: loss or weights are no longer finite; {left}; "
                    "try a lower learning rate, and look for inputs that are not finite"
                )
            known = {name: values[np.isfinite(values)] for name, values in metrics.items()}
            scalars = {name: float(values.mean()) for name, values in known.items() if values.size}
            scalars[work.unit] = done * work.amount
            scalars[f"{work.unit}_per_second"] = work.amount / seconds
            run.log(done, scalars)
            shown = (f"{name} {scalars[name]:.4g}" for name in work.shown if name in scalars)
            progress.advance(work.amount, "  ".join(shown))
            if done % config.checkpoint_every == 0:
                save()
        if done % config.checkpoint_every:
            save()
    if done < iterations:
        raise TrainingInterrupted(
            f"stopped after iteration {done} of {iterations}, all saved; "
            f"go on with --resume {run.outermost}"
        )
    return parallel.gather(mesh, state)


@lru_cache(maxsize=1)
def _compiled(algorithm: Algorithm[Any], mesh: Mesh, kind: Any, shapes: tuple[Any, ...]) -> Any:
    """For data and state of a kind of pytree with leaves of these shapes and types."""

    def compiles() -> jax.stages.Compiled:
        _log.info("compiling for %d of %d devices ...", mesh.size, jax.device_count())
        start, whole = time.perf_counter(), parallel.shardings(mesh)
        shared = parallel.shardings(mesh, algorithm.specs)
        kinds = jax.tree.unflatten(kind, [jax.ShapeDtypeStruct(*shape) for shape in shapes])
        places = jax.tree.broadcast((whole, shared), kinds)
        given = jax.tree.map(lambda x, place: x.update(sharding=place), kinds, places)
        iterate = jax.jit(algorithm.iterate, donate_argnums=1, out_shardings=(shared, whole))
        with jax.set_mesh(mesh):
            done = iterate.lower(*given).compile()
        _log.info("compiled in %.0f s", time.perf_counter() - start)
        return done

    decided_by = algorithm, str(kind), [(shape, str(dtype)) for shape, dtype in shapes]
    done = kept.program(decided_by, mesh, compiles)
    machine.release_memory()
    return done


@contextlib.contextmanager
def _interruptible() -> Iterator[list[int]]:
    """The first Ctrl-C or SIGTERM is noted in the list that this gives, a second acts as always."""
    seen: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def as_before() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(number: int, frame: FrameType | None) -> None:
        seen.append(number)
        as_before()
        _log.info("\nstopping after this iteration; Ctrl-C again stops at once")

    for number in before:
        signal.signal(number, note)
    try:
        yield seen
    finally:
        as_before()
