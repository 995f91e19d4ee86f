"""What tests of commands share."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache

Door = Callable[[Sequence[str] | None], None]


@contextmanager
def opened(door: Door, folder: Path, *first: str) -> Iterator[Callable[..., Path]]:
    """The command as a function of its arguments, which gives the newest run folder.

    first: arguments of every run that does not go on with an earlier one.
    """
    # What one run has compiled, the next finds there.
    cache, runs = ["--compile-cache", str(folder / "compiled")], folder / "runs"

    def run(*argv: str) -> Path:
        begin = [] if "--resume" in argv else [*first, "--runs", str(runs)]
        door([*begin, *cache, *argv])
        return max(runs.iterdir(), key=lambda run: run.stat().st_ctime_ns)

    try:
        yield run
    finally:
        jax.config.update("jax_compilation_cache_dir", None)
        compilation_cache.reset_cache()  # Else later tests go on writing to it.


def refusal(door: Door, *argv: object) -> str:
    """The one line that a command ends in."""
    with pytest.raises(SystemExit) as stop:
        door([str(word) for word in argv])
    message = stop.value.code
    assert isinstance(message, str) and message.startswith("error: ") and "\n" not in message
    return message
