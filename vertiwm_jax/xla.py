"""Options of XLA, the compiler, and where its programs are kept.

Options that the installed version does not know are left out.
"""

import functools
import hashlib
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

import jax
import platformdirs

_BRIEF = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
_READ_FLAGS = "from jaxlib import xla_client; xla_client.CompileOptions()"
_CPU = ("vendor_id", "cpu family", "model", "model name", "flags", "Features")
_KEPT = 1 << 30  # bytes
GONE = {"compile_cache": "is now JAX_COMPILATION_CACHE_DIR in the environment"}
"""A setting that configurations had, and what is in its place."""
_left_out: set[str] = set()
_keeps = False


def left_out() -> list[str]:
    """Options that this package asks for and that the installed XLA does not know."""
    brief_options()
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


def keeps_compiled() -> bool:
    """Whether `keep_compiled` was called."""
    return _keeps


def keep_compiled() -> None:
    """Keeps compiled programs for later processes; beyond 1 GB, those used longest ago go.

    They lie where JAX was told (`JAX_COMPILATION_CACHE_DIR`), or in the user's folder of caches, in
    one for this kind of CPU. `JAX_ENABLE_COMPILATION_CACHE=false` turns it off.
    """
    global _keeps
    _keeps = True
    if not jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        kept = platformdirs.user_cache_path("vertiwm_jax") / f"programs-{cpu()}"
        jax.config.update("jax_compilation_cache_dir", str(kept))
    jax.config.update("jax_compilation_cache_max_size", _KEPT)
    # Small ones too: a start has a hundred of them.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def cpu() -> str:
    """A name of this kind of CPU: a program for one may not run on another.

    JAX does not tell them apart (jax-ml/jax#38445).
    """
    told, cpuinfo = [platform.machine(), platform.processor()], Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        first = cpuinfo.read_text(encoding="utf-8").split("\n\n")[0].splitlines()
        told += [line for line in first if line.split(":")[0].strip() in _CPU]
    return hashlib.sha256("\n".join(told).encode()).hexdigest()[:12]


def _accepts(flags: Iterable[str]) -> bool:
    """Whether a process accepts these flags."""
    environment = {**os.environ, "XLA_FLAGS": " ".join(flags)}
    command = [sys.executable, "-c", _READ_FLAGS]
    return subprocess.run(command, env=environment, capture_output=True).returncode == 0


@functools.cache
def brief_options() -> dict[str, int]:
    """Compiler options for programs that run only briefly: they compile in half the time.

    What `XLA_FLAGS` sets stays as it is. To ask for them starts JAX.
    """
    given = os.environ.get("XLA_FLAGS", "")
    options = {name: value for name, value in _BRIEF.items() if name not in given}
    return {name: value for name, value in options.items() if _knows(name, value)}


def _knows(name: str, value: int) -> bool:
    """Tries whether the compiler accepts an option."""
    try:
        jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
    except jax.errors.JaxRuntimeError:
        _left_out.add(name)
        return False
    return True
