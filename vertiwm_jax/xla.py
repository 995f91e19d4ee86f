"""Options of XLA, the compiler. Options that the installed version does not know are left out."""

import functools
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import jax

T = TypeVar("T")

_BRIEF = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
_READ_FLAGS = "from jaxlib import xla_client; xla_client.CompileOptions()"
_left_out: set[str] = set()


def left_out() -> list[str]:
    """Options that this package asks for and that the installed XLA does not know."""
    _brief_options()
    return sorted(_left_out)


def add_flags(flags: Mapping[str, int | str]) -> None:
    """Adds flags that are not set yet to `XLA_FLAGS`, which JAX reads when it starts.

    An unknown flag would end the process. So another process tries them first, in 0.2 s.
    """
    given = os.environ.get("XLA_FLAGS", "")
    new = {name: f"--{name}={value}" for name, value in flags.items() if name not in given}
    if new and not _accepts(new.values()):
        _left_out.update(name for name, flag in new.items() if not _accepts([flag]))
    added = (flag for name, flag in new.items() if name not in _left_out)
    os.environ["XLA_FLAGS"] = " ".join([given, *added]).strip()


def brief_jit(function: Callable[..., T], **options: Any) -> Callable[..., T]:
    """`jax.jit` for a program that runs only briefly: it compiles in about half the time.

    Loops that use vector units run many times slower in it.

    options: those of `jax.jit`; `compiler_options` are added to those that shorten compilation.
    """
    extra = options.pop("compiler_options", {})

    @functools.cache  # To ask for options starts JAX, which is too early where this is imported.
    def compiled() -> Callable[..., T]:
        return jax.jit(function, compiler_options=_brief_options() | extra, **options)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> T:
        return compiled()(*args, **kwargs)

    return call


def _accepts(flags: Iterable[str]) -> bool:
    """Whether a process accepts these flags."""
    environment = {**os.environ, "XLA_FLAGS": " ".join(flags)}
    command = [sys.executable, "-c", _READ_FLAGS]
    return subprocess.run(command, env=environment, capture_output=True).returncode == 0


@functools.cache
def _brief_options() -> dict[str, int]:
    return {name: value for name, value in _BRIEF.items() if _knows(name, value)}


def _knows(name: str, value: int) -> bool:
    """Tries whether the compiler accepts an option."""
    try:
        jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
    except jax.errors.JaxRuntimeError:
        _left_out.add(name)
        return False
    return True
