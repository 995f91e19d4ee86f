"""Files and folders that are written as a whole, or not at all."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from vertiwm_jax.errors import UserError


class WriteError(UserError):
    """A file or folder that cannot be written; the message names the path."""


def expect_folder(folder: str | Path) -> None:
    """Raises `WriteError` unless files can be written to a folder, which need not be there yet.

    For commands, before they compute what they will write.
    """
    place = Path(folder).absolute()
    while not os.path.lexists(place):
        place = place.parent
    try:
        with tempfile.TemporaryFile(dir=place):
            pass
    except OSError as error:
        raise WriteError(f"{folder}: cannot write there: {error.strerror}: {place}") from error


def expect_file(path: str | Path) -> None:
    """Raises `WriteError` unless a file can be written, or replaced, in a folder that is there."""
    path = Path(path)
    if path.is_dir():
        raise WriteError(f"{path}: expected a file to write, found a folder")
    if not path.parent.is_dir():
        raise WriteError(f"{path}: expected a folder {path.parent} to write to, found none")
    expect_folder(path.parent)


def write(path: str | Path, data: bytes | str) -> None:
    """Replace the file at `path` by `data` as a whole, or not at all.

    Text is written as UTF-8. On any failure the old content stays and no partial file is left;
    what the system refuses (a full disk, no permission) raises `WriteError`.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        try:
            with partial.open("wb") as file:
                file.write(data.encode() if isinstance(data, str) else data)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise WriteError(f"{path}: cannot write, the file is as it was: {error}") from error


@contextlib.contextmanager
def new_content(path: str | Path) -> Iterator[Path]:
    """A file to fill, which then replaces the one at `path`, like `write`.

    For writers that need a file.
    """
    path = Path(path)
    with tempfile.TemporaryDirectory() as folder:
        unfinished = Path(folder) / path.name
        yield unfinished
        write(path, unfinished.read_bytes())


@contextlib.contextmanager
def new_folder(path: str | Path) -> Iterator[Path]:
    """A folder to fill, which then becomes the new folder at `path` as a whole, or not at all.

    A folder that exists already, or that cannot be made, raises `WriteError`.
    """
    path = Path(path)
    if path.exists():
        raise WriteError(f"{path}: expected no such folder yet, found one; remove it first")
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
    except OSError as error:
        raise WriteError(f"{path}: cannot make the folder: {error}") from error
    try:
        yield partial
        partial.rename(path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
