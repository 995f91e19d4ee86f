"""Training of an RL algorithm: the host loop around several seeds at once."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

import jax

from vertiwm_jax import parallel, training
from vertiwm_jax.config import Count, settings
from vertiwm_jax.runs import Run
from vertiwm_jax.training import Algorithm, CheckpointConfig, Work

State = TypeVar("State")


@settings
class LoopConfig(CheckpointConfig):
    """What is kept of a training, and how often it is done."""

    seeds: Count = 1
    """Trainings with different random keys, run side by side."""


@dataclass(frozen=True)
class Seeds(Generic[State]):
    """An algorithm with several random keys; every leaf of its state has an axis of seeds."""

    algorithm: Algorithm[State]
    seeds: int

    def init(self, env_params: Any, key: jax.Array) -> State:
        keys = jax.random.split(key, self.seeds)
        # One after the other: batched QR decompositions, of which orthogonal weights are made, wait
        # for each other for ever on a CPU of few cores (jaxlib 0.10).
        return jax.lax.map(partial(self.algorithm.init, env_params), keys)

    def iterate(self, env_params: Any, state: State) -> tuple[State, dict[str, jax.Array]]:
        if self.seeds == 1:  # an axis of one makes XLA compile slower sums
            alone = jax.tree.map(lambda x: x[0], state)
            return jax.tree.map(lambda x: x[None], self.algorithm.iterate(env_params, alone))
        # As many seeds on every device, or else a share of the environments of all of them.
        each = parallel.vmap if self.seeds % parallel.number() == 0 else jax.vmap
        return each(self.algorithm.iterate, (None, 0))(env_params, state)


def restore(
    algorithm: Algorithm[State], env_params: Any, folder: Path, seeds: int
) -> tuple[int, State] | None:
    """Iterations done and state in the newest checkpoint of the run in `folder`, if it has one.

    A checkpoint of another configuration raises `CheckpointError`.
    """
    return training.restore(Seeds(algorithm, seeds), env_params, folder)


def prepare(algorithm: Algorithm[Any], env_params: Any, seeds: int, batch: int) -> None:
    """Compiles what `train` runs; shapes of parameters are enough. batch: as there."""
    training.compiled(Seeds(algorithm, seeds), env_params, batch)


def train(
    algorithm: Algorithm[State],
    env_params: Any,
    key: jax.Array,
    run: Run,
    iterations: int,
    transitions: int,
    batch: int,
    config: LoopConfig,
    restored: tuple[int, State] | None = None,
    saved: Callable[[State], None] = lambda state: None,
) -> State:
    """`training.train` for `config.seeds` seeds; metrics are means over those that have a value.

    transitions: environment steps of one seed in one iteration, for rates and metrics. batch: what
        divides the sizes of its batches, for devices to share.
    """
    work = Work("transitions", transitions * config.seeds, ("episode_return", "success"), batch)
    seeds = Seeds(algorithm, config.seeds)
    return training.train(seeds, env_params, key, run, iterations, work, config, restored, saved)
