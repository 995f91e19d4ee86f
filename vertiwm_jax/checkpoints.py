"""Checkpoints of a whole training state, written as a whole or not at all."""

import contextlib
import logging
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from orbax.checkpoint import v1 as ocp

from vertiwm_jax import hosts
from vertiwm_jax.errors import UserError

State = TypeVar("State")

_PARTIAL = "*.orbax-checkpoint-tmp*"


class CheckpointError(UserError):
    """A checkpoint that cannot be written or read; the message names the path and the mend."""


def save(folder: str | Path, step: int, state: Any, keep: int) -> Path:
    """Write `state` as `folder/step` and then delete all but the newest `keep` checkpoints.

    state: any pytree of non-empty arrays, random keys included, whole on every device. Of several
        hosts the first one writes.
    Until a checkpoint is complete it has another name, so whatever interrupts the write leaves
    the earlier ones as they are. What the system refuses (a full disk) raises `CheckpointError`.
    """
    own = Path(folder).absolute()
    # The storage library wants all hosts to call it, with one path.
    folder = hosts.path_of_first(own)
    path = folder / str(step)
    try:
        own.mkdir(parents=True, exist_ok=True)
        if hosts.is_first():
            _clean(folder)
        with _quiet():
            leaves = jax.device_get(hosts.without_keys(named_leaves(state)))
            writing = ocp.save_async(str(path), leaves)
            try:
                writing.result()
            except KeyboardInterrupt:
                writing.result()  # Its threads hang where Python ends before they do.
                raise
    # The storage library reports what the system refuses as ValueError.
    except (OSError, ValueError) as error:
        _clean(folder)
        previous = latest(folder)
        kept = f"the checkpoint {previous} is still good" if previous else "there is none before"
        reason = str(error).splitlines()[0]
        raise CheckpointError(
            f"{path}: cannot write the checkpoint ({kept}); free space on the disk: {reason}"
        ) from error
    if hosts.is_first():
        for old in _complete(folder)[:-keep]:
            shutil.rmtree(old, ignore_errors=True)
    return path


def latest(folder: str | Path) -> Path | None:
    """The newest complete checkpoint in `folder`, whose name is its step; None if there is none."""
    checkpoints = _complete(Path(folder).absolute())
    return checkpoints[-1] if checkpoints else None


def load(path: str | Path, like: State) -> State:
    """Read the checkpoint at `path` into the structure of `like`, arrays or `jax.eval_shape`'s.

    A checkpoint with other leaves, shapes or types raises `CheckpointError` that names the first.
    """
    path = Path(path).absolute()
    stored = named_leaves(jax.eval_shape(hosts.without_keys, like))
    _check(path, stored, outline(path))
    with _reading(path):
        arrays = {name: np.empty(leaf.shape, leaf.dtype) for name, leaf in stored.items()}
        restored = jax.device_put(ocp.load(str(path), arrays))
    leaves = [restored[name] for name in stored]
    return hosts.with_keys(like, jax.tree.unflatten(jax.tree.structure(like), leaves))


def outline(path: str | Path) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes and types of the leaves of a checkpoint by dotted name; raises `CheckpointError`."""
    path = Path(path).absolute()
    with _reading(path):
        found = ocp.metadata(str(path)).metadata
        return {name: jax.ShapeDtypeStruct(x.shape, x.dtype) for name, x in found.items()}


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """In which this host reads by itself, and a damaged checkpoint raises `CheckpointError`."""
    try:
        with _quiet(), _alone():
            yield
    except (OSError, ValueError, KeyError) as error:
        reason = str(error).splitlines()[0]
        raise CheckpointError(f"{path}: not a readable checkpoint: {reason}") from error


def _alone() -> ocp.Context:
    """In which this host reads by itself."""
    this = jax.process_index()
    options = ocp.options.MultiprocessingOptions(primary_host=this, active_processes={this})
    return ocp.Context(multiprocessing_options=options)


def named_leaves(tree: Any) -> dict[str, Any]:
    """Leaves by dotted name, so that a file depends on no class of ours."""
    leaves = jax.tree.leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _check(path: Path, expected: dict[str, Any], found: dict[str, Any]) -> None:
    for name in [*expected, *(name for name in found if name not in expected)]:
        want = _describe(expected[name]) if name in expected else "nothing"
        have = _describe(found[name]) if name in found else "nothing"
        if want != have:
            raise CheckpointError(
                f"{path}: {name}: expected {want}, found {have}; the checkpoint belongs to "
                "another configuration, resume with the one in its run folder"
            )


def _describe(leaf: Any) -> str:
    return f"{leaf.dtype}{list(leaf.shape)}"


def _complete(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    names = (path for path in folder.iterdir() if path.name.isdecimal())
    return sorted(names, key=lambda path: int(path.name))


def _clean(folder: Path) -> None:
    for partial in folder.glob(_PARTIAL):
        shutil.rmtree(partial, ignore_errors=True)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keeps the storage library from printing the traces of errors that are raised anyway."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
