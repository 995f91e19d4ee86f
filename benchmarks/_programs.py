"""Programs that are compiled for one device ahead of their use, several at a time."""

import time
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import jax

from vertiwm_jax import machine

Job = tuple[Callable[..., Any], tuple[Any, ...]]
"""A function and its arguments."""
Name = TypeVar("Name", bound=Hashable)


@dataclass
class Program:
    """A function that is lowered for one device, with its arguments there, and can be compiled.

    found: what that took, and what it needs.
    """

    lowered: Any
    given: tuple[Any, ...]
    on: jax.Device
    found: dict[str, float]
    compiled: Any = None

    @classmethod
    def of(cls, job: Job, on: jax.Device, precision: str | None = None) -> "Program":
        """precision: of matrix products whose code asks for none; what JAX was told by default."""
        function, given = job[0], jax.device_put(job[1], on)
        start = time.monotonic()
        with jax.default_matmul_precision(precision or jax.config.jax_default_matmul_precision):
            traced = jax.jit(function).trace(*given)
            half = time.monotonic()
            lowered = traced.lower()
        found = {"trace_s": half - start, "lower_s": time.monotonic() - half}
        return cls(lowered, given, on, found)

    def compile(self) -> "Program":
        """This one, compiled, if it was not."""
        if self.compiled is None:
            start = time.monotonic()
            self.compiled = self.lowered.compile()
            self.found["compile_s"] = time.monotonic() - start
            if needs := self.compiled.memory_analysis():
                sizes = (f"{kind}_size_in_bytes" for kind in ("argument", "output", "temp"))
                self.found["program_GB"] = sum(getattr(needs, size) for size in sizes) / 1e9
        return self

    def __call__(self) -> Any:
        return jax.block_until_ready(self.compile().compiled(*self.given))


def compiled(makers: Mapping[Name, Callable[[], Program]]) -> dict[Name, Future[Program]]:
    """Programs that are being compiled by all cores, or what hindered them.

    They are made one after the other, for that runs programs, which several threads must not do on
    a CPU of few cores: they wait for each other for ever.
    """
    futures = {}
    pool = ThreadPoolExecutor(machine.cores())
    for name, make in makers.items():
        try:
            futures[name] = pool.submit(make().compile)
        except Exception as error:
            futures[name] = Future()
            futures[name].set_exception(error)
    pool.shutdown(wait=False)
    return futures
