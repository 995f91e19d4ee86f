"""Stages of a fit. Each has a folder, and is run once for the same inputs."""

import hashlib
import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from vertiwm_jax import atomic, checkpoints
from vertiwm_jax.dynamics import Params
from vertiwm_jax.learning import fitting
from vertiwm_jax.learning.fitting import FitConfig, Problem
from vertiwm_jax.runs import Run
from vertiwm_jax.training import CheckpointConfig

_log = logging.getLogger(__name__)
INPUTS = "inputs.txt"
"""File in the folder of a stage that lists its inputs."""


@dataclass(frozen=True)
class Inputs:
    """Everything that the result of a stage depends on, except program and machine.

    learns_from: kinds of drives; drives: all files of drives with their sizes and a digest of what
        their drives are for, since the constants of a model are measured on them. before: `digest`
        of the stages that it builds on.
    """

    problem: Problem
    config: FitConfig
    seed: tuple[int, ...]
    learns_from: tuple[str, ...]
    drives: tuple[tuple[str, int, int], ...]
    before: tuple[str, ...] = ()

    def __str__(self) -> str:
        schedule = replace(self.config, checkpoints=CheckpointConfig())
        lines = [self.problem, schedule, self.seed, self.learns_from, *self.drives, *self.before]
        return "".join(f"{line}\n" for line in lines)

    @property
    def digest(self) -> str:
        return hashlib.sha256(str(self).encode()).hexdigest()


def digest(params: Params) -> str:
    """A digest of parameters."""
    sum_ = hashlib.sha256()
    for path, leaf in jax.tree.leaves_with_path(params):
        sum_.update(f"{jax.tree_util.keystr(path)} {leaf.shape} {leaf.dtype}".encode())
        sum_.update(np.asarray(leaf).tobytes())
    return sum_.hexdigest()


def fit(
    run: Run,
    name: str,
    inputs: Inputs,
    params: Params,
    data: Callable[[], Any],
    key: jax.Array,
    reuse: Sequence[Path],
) -> Any:
    """Runs `fitting.fit` in the folder `name` of the run.

    A stage that has ended with the same inputs, there or in a run of `reuse`, is not repeated. A
    stage that has begun with them goes on from its newest checkpoint. A stage with other inputs is
    deleted and begins again. A stage of 0 updates is left out.
    """
    if not inputs.config.updates:
        return params
    folder = run.folder / name
    if folder.exists() and not _is_of(folder, inputs):
        _log.info("\n%s: its inputs have changed, it begins anew", name)
        shutil.rmtree(folder)
    for other in reuse:
        if not folder.exists() and _is_of(other / name, inputs):
            _log.info("\n%s: from %s", name, other)
            copy = run.folder / f".{name}"
            shutil.copytree(other / name, copy, dirs_exist_ok=True)
            copy.rename(folder)
    done = fitting.load(folder, params)
    if done is not None:
        return done
    _log.info("\n%s", name)
    checkpoint = checkpoints.latest(folder / "checkpoints")
    with run.part(name, int(checkpoint.name) if checkpoint else 0, inputs.config) as part:
        atomic.write(folder / INPUTS, str(inputs))
        return fitting.fit(inputs.problem, inputs.config, params, data(), key, part)


def _is_of(folder: Path, inputs: Inputs) -> bool:
    file = folder / INPUTS
    return file.is_file() and file.read_text(encoding="utf-8") == str(inputs)
