"""Fitting parameters to data: stochastic gradient descent as one compiled algorithm.

A `Problem` says what is fitted, and to what data. It draws each batch by a random key.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
import optax
from flax import struct

from vertiwm_jax import checkpoints, training
from vertiwm_jax.config import ConfigError, Count, CountOrZero, NotNegative, Positive, settings
from vertiwm_jax.dynamics import Params
from vertiwm_jax.runs import Run
from vertiwm_jax.training import Algorithm, CheckpointConfig, Work

RESULT = "fitted"
"""Folder in that of the run that holds the parameters a fit ended with."""
LAST_LEARNING_RATE = 0.01
"""At the end of the schedule, as a share of the highest."""
SECOND_MOMENT = 0.99
"""Decay of squared gradients (Adam's beta 2): crashes make some large ones, soon forgotten."""
LARGEST_SKIPPED = 0.1
"""Share of the updates of an iteration whose gradients may be infinite or NaN."""


class Problem(Protocol):
    """What is fitted: a loss on random batches of data, and an error on data held out."""

    @property
    def config(self) -> Any:
        """Settings; their `batch` is the number of rows in a batch, which devices can share."""
        ...

    def loss(self, params: Params, data: Any, key: jax.Array, /) -> jax.Array:
        """The loss `[]` on the batch that the key draws."""
        ...

    def validate(self, params: Params, data: Any, /) -> dict[str, jax.Array]:
        """Scalars to report; the parameters with the lowest `error` are kept. NaN is no value."""
        ...


@settings
class FitConfig:
    """How parameters are fitted."""

    GONE: ClassVar[dict[str, str]] = {"accumulate": "is now grad_accumulation"}

    updates: CountOrZero = 10_000
    """Optimizer steps (AdamW), each on new batches; 0 leaves the stage out."""
    updates_per_iteration: Count = 100
    """Updates between two validations; one compiled call does them."""
    grad_accumulation: Count = 1
    """Batches whose gradients make one update: a larger batch in the memory of one."""
    learning_rate: Positive = 1e-3
    """The highest; it rises linearly to it and falls as a cosine."""
    warm_up: int = 200
    """Updates until the highest learning rate."""
    weight_decay: NotNegative = 1e-4
    """Decay of all trained parameters, also of those without a gradient, times learning rate."""
    max_gradient_norm: Positive = 1.0
    """Gradients are clipped to this global norm."""
    trainable: tuple[str, ...] = ()
    """Entries of the parameters that are trained, dotted like "gate.network"; all when empty."""
    checkpoints: CheckpointConfig = CheckpointConfig(checkpoint_every=5, keep=1)
    """What is kept of the training."""

    def check(self):
        if self.updates % self.updates_per_iteration:
            raise ValueError(
                f"updates: expected a multiple of updates_per_iteration, "
                f"{self.updates_per_iteration}, found {self.updates}"
            )
        if self.updates and not 0 <= self.warm_up < self.updates:
            raise ValueError(
                f"warm_up: expected 0 to {self.updates - 1} updates, found {self.warm_up}"
            )


@struct.dataclass
class FitInputs:
    """What a fit starts from and what it learns from.

    params: all parameters; those that are not trained stay what they are. data: the problem's.
    """

    params: Params
    data: Any


@struct.dataclass
class FitState:
    """A fit between two updates. Parameters that are not trained are None in `trained`, `best`.

    update: `[]` int32, updates done. key: from which, with `update`, all randomness follows.
    best, best_error: the parameters with the lowest validation error so far, and that error.
    """

    trained: Params
    optimizer: optax.OptState
    update: jax.Array
    key: jax.Array
    best: Params
    best_error: jax.Array


@dataclass(frozen=True)
class Fit(Algorithm[FitState]):
    """The algorithm that fits a problem; `FitInputs` is what it learns from."""

    problem: Problem
    config: FitConfig

    @property
    def batch(self) -> int:
        return self.problem.config.batch

    def init(self, data: FitInputs, key: jax.Array) -> FitState:
        """The beginning; `ConfigError` if `trainable` names what the parameters do not have."""
        trained = _pick(data.params, self.config.trainable)
        return FitState(
            trained=jax.tree.map(partial(jnp.array, copy=True), trained),
            optimizer=self._optimizer.init(trained),
            update=jnp.int32(0),
            key=key,
            best=jax.tree.map(partial(jnp.array, copy=True), trained),
            best_error=jnp.float32(jnp.inf),
        )

    def iterate(self, data: FitInputs, state: FitState) -> tuple[FitState, dict[str, jax.Array]]:
        """`updates_per_iteration` updates and a validation.

        An update whose gradients are not finite is skipped. Metrics are means over the updates,
        the share that was `skipped`, and those of the validation.
        """
        updates = self.config.updates_per_iteration
        update = partial(self._update, data)
        state, metrics = jax.lax.scan(lambda state, _: update(state), state, length=updates)
        params = merge(data.params, state.trained)
        validated = self.problem.validate(params, data.data)
        error = validated["error"]
        better = error < state.best_error
        best = jax.tree.map(partial(jnp.where, better), state.trained, state.best)
        state = replace(state, best=best, best_error=jnp.where(better, error, state.best_error))
        means = jax.tree.map(jnp.nanmean, metrics)
        finite = (means["skipped"] <= LARGEST_SKIPPED) & jnp.isfinite(error)
        best_error = {"best_error": state.best_error, "finite": finite}
        return state, {**means, **validated, **best_error}

    def _update(self, inputs: FitInputs, state: FitState) -> tuple[FitState, dict[str, jax.Array]]:
        def loss(trained: Params, batch: jax.Array) -> jax.Array:
            key = jax.random.fold_in(state.key, batch)
            return self.problem.loss(merge(inputs.params, trained), inputs.data, key)

        several = self.config.grad_accumulation
        value, gradient = training.mean_in_turns(
            partial(jax.value_and_grad(loss), state.trained),
            state.update * several + jnp.arange(several),
        )
        norm = optax.tree.norm(gradient)
        updates, optimizer = self._optimizer.update(gradient, state.optimizer, state.trained)
        trained, finite = optax.apply_updates(state.trained, updates), jnp.isfinite(norm)
        state = replace(state, trained=trained, optimizer=optimizer, update=state.update + 1)
        norm, skipped = jnp.where(finite, norm, jnp.nan), jnp.float32(~finite)
        return state, {"loss": value, "gradient_norm": norm, "skipped": skipped}

    @property
    def _optimizer(self) -> optax.GradientTransformation:
        config = self.config
        highest, last = config.learning_rate, LAST_LEARNING_RATE * config.learning_rate
        lengths = config.warm_up, config.updates
        rate = optax.warmup_cosine_decay_schedule(0.0, highest, *lengths, last)
        descent = optax.chain(
            optax.clip_by_global_norm(config.max_gradient_norm),
            optax.adamw(rate, b2=SECOND_MOMENT, weight_decay=config.weight_decay),
        )
        # Never applied, however many there are in a row: too many end the training.
        return optax.apply_if_finite(descent, max_consecutive_errors=config.updates)


def fit(
    problem: Problem, config: FitConfig, params: Params, data: Any, key: jax.Array, run: Run
) -> Params:
    """The parameters with the lowest validation error, those not trained included.

    They are also saved in the folder of `run`, for `load`. Goes on from the newest checkpoint of
    `run` if it has one, to the same numbers as without a stop. Raises what `training.train` and
    `checkpoints.save` raise.
    """
    params, data = jax.device_put((jax.tree.map(jnp.asarray, params), data))
    inputs, algorithm = FitInputs(params, data), Fit(problem, config)
    restored = training.restore(algorithm, inputs, run.folder)
    each, kept = config.updates_per_iteration, config.checkpoints
    iterations, work = config.updates // each, Work("updates", each, ("loss", "error"))
    state = training.train(algorithm, inputs, key, run, iterations, work, kept, restored)
    fitted = merge(params, state.best)
    if not (run.folder / RESULT / str(config.updates)).is_dir():
        checkpoints.save(run.folder / RESULT, config.updates, fitted, keep=1)
    return fitted


def load(folder: Path, like: Params) -> Params | None:
    """What `fit` gave in the run `folder`, in the structure of `like`; None if it has not ended."""
    path = checkpoints.latest(folder / RESULT)
    return checkpoints.load(path, like) if path else None


def merge(params: Params, trained: Params) -> Params:
    """All parameters, with those that are not None in `trained` taken from there."""
    return jax.tree.map(
        lambda new, old: old if new is None else new, trained, params, is_leaf=lambda x: x is None
    )


def _pick(params: Params, trainable: tuple[str, ...]) -> Params:
    """The parameters with None for what is not trained."""

    def within(path: jax.tree_util.KeyPath, entry: str) -> bool:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        return f"{name}.".startswith(f"{entry}.")

    paths = [path for path, _ in jax.tree.leaves_with_path(params)]
    for entry in trainable:
        if not any(within(path, entry) for path in paths):
            first = dict.fromkeys(jax.tree_util.keystr(path[:1], simple=True) for path in paths)
            raise ConfigError(
                f"trainable: expected entries like {', '.join(first)}, or some within them; "
                f"found {entry!r}"
            )

    def choose(path: jax.tree_util.KeyPath, leaf: jax.Array) -> jax.Array | None:
        return leaf if not trainable or any(within(path, entry) for entry in trainable) else None

    return jax.tree.map_with_path(choose, params)
