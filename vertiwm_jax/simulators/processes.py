"""Runs simulations in several processes, each of which moves one vehicle at a time."""

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

from vertiwm_jax.simulators.protocol import SimulatorError

Map = Callable[..., Iterator[Any]]
"""`map`, or the same in several processes; functions and values must pickle."""


@contextmanager
def simulating(jobs: int) -> Iterator[Map]:
    """`map`, in this process or in several; raises `SimulatorError` if one of them is killed."""
    if jobs == 1:
        yield map
        return
    # Not forked: JAX has threads. Ctrl-C is for this process, which then ends the others.
    ignore = signal.SIGINT, signal.SIG_IGN
    executor = ProcessPoolExecutor(jobs, get_context("spawn"), signal.signal, ignore)
    try:
        yield executor.map
    except BrokenProcessPool:
        raise SimulatorError(
            "a process that simulated was killed, perhaps for want of memory; fewer jobs need less"
        ) from None
    finally:
        executor.shutdown(cancel_futures=True)
