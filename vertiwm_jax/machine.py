"""What this machine has: cores, memory, and how fast it multiplies."""

import contextlib
import ctypes
import os
import sys
import time
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax import hosts, kept, xla
from vertiwm_jax.errors import UserError

_PATIENCE = 7 * 24 * 3600  # seconds
_WORTH_ROUNDING = 0.75  # of the time; 0.55 was measured with AVX512_BF16, above 1.5 without


_process = os.getpid()
"""In which JAX may start, or has started."""


def refuse_forked() -> None:
    """`UserError` in a process that was forked from one in which JAX had started.

    JAX would wait for ever for threads that only the other process has.
    """
    global _process
    if os.getpid() == _process:
        return
    devices = jax.config.jax_num_cpu_devices  # pyright: ignore[reportAttributeAccessIssue]
    try:
        jax.config.update("jax_num_cpu_devices", devices + 1)
    except RuntimeError:  # It cannot be changed after JAX has started.
        raise UserError(
            "processes: JAX has started before this process was forked, and does not run in it; "
            'start processes by multiprocessing.get_context("spawn"), or context="spawn"'
        ) from None
    jax.config.update("jax_num_cpu_devices", devices)
    _process = os.getpid()


def cores() -> int:
    """Cores that this process may use."""
    # Affinity is Linux only; elsewhere every core may be used.
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def use_cores() -> None:
    """Makes every core of a CPU a device, unless `JAX_NUM_CPU_DEVICES` sets their number.

    Two devices of one core each are faster than one of two cores, whose cores wait for each other
    after every operation (docs/scaling.md). `RuntimeError` where JAX has started already with
    another number of them.
    """
    # Where another program takes one core, the others wait; after 60 s XLA would end the process.
    limits = ("warn_stuck", "terminate")
    xla.add_flags(
        {f"xla_cpu_collective_call_{limit}_timeout_seconds": _PATIENCE for limit in limits}
    )
    if "JAX_NUM_CPU_DEVICES" in os.environ:
        return
    try:
        jax.config.update("jax_num_cpu_devices", cores())
    except RuntimeError as error:
        if (found := jax.local_device_count("cpu")) == cores():
            return
        raise RuntimeError(
            f"use_cores: JAX has started with {found} CPU device(s) of {cores()}. Call it before "
            "whatever starts JAX, as to import gymnax or an environment of this package does, or "
            f"set JAX_NUM_CPU_DEVICES={cores()}"
        ) from error


@cache
def multiplies_bfloat16() -> bool:
    """Whether this is a CPU that multiplies matrices of bfloat16 clearly faster than of float32.

    It is tried, which takes half a second. Of several hosts, which all have to ask, it is
    what the first one finds.
    """
    if jax.default_backend() != "cpu":
        return False
    single, half = _seconds_of_matmul(jnp.float32, jnp.bfloat16)
    return bool(hosts.of_first(np.array(half < _WORTH_ROUNDING * single)))


def together(cpu: int, accelerator: int) -> int:
    """How much of a batch one device works at together.

    Args:
        cpu: as much as stays in the cache of a core.
        accelerator: as much as fills one and fits into its memory.
    """
    return cpu if jax.default_backend() == "cpu" else accelerator


def release_memory() -> None:
    """Gives back to the system what compilers have freed, which glibc keeps for later."""
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # Other C libraries have no such function.
            ctypes.CDLL(None).malloc_trim(0)


def forget_programs() -> None:
    """Gives back the memory of all that was compiled, before what will not call it again.

    What is held as compiled, as by `training.compiled`, stays.
    """
    jax.clear_caches()
    kept.forget()
    release_memory()


def _seconds_of_matmul(*dtypes: Any) -> list[float]:
    """The shortest of many products of matrices of each type, in turns: others may be busy here."""
    matmul = jax.jit(partial(jnp.matmul, preferred_element_type=jnp.float32))
    operands = [(jnp.ones((256, 512), kind), jnp.ones((512, 512), kind)) for kind in dtypes]
    seconds = []
    for _ in range(200):  # The first of which compiles.
        for pair in operands:
            start = time.perf_counter()
            matmul(*pair).block_until_ready()
            seconds.append(time.perf_counter() - start)
    return np.reshape(seconds, (-1, len(dtypes))).min(axis=0).tolist()
