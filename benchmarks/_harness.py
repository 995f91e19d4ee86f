"""Timing that means something: compile apart, warm-up, finished work, hardware beside it."""

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.table import Table

from vertiwm_jax import machine

Figures = Mapping[str, float | int | str]


def parser(description: str | None) -> argparse.ArgumentParser:
    """An argument parser with `--json`; a benchmark adds its own options."""
    made = argparse.ArgumentParser(description=description)
    made.add_argument("--json", action="store_true", help="print one JSON object")
    return made


def measure(
    function: Callable[..., Any], *args: Any, repeats: int = 10, seconds: float = 1.0
) -> dict[str, float | int]:
    """Time `function(*args)` in s, each call until its result is ready.

    The first call, which compiles, is told apart; one more warms up. Then at least `repeats`
    calls are timed, and more until `seconds` have passed. The arguments are used again in every
    call, so a function must not donate them.
    """

    def call() -> float:
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        return time.perf_counter() - start

    first = call()
    call()
    times: list[float] = []
    while len(times) < repeats or sum(times) < seconds:
        times.append(call())
    return {
        "median_s": statistics.median(times),
        "min_s": min(times),
        "calls": len(times),
        "first_call_s": first,
    }


def hardware() -> dict[str, str | int]:
    """What the figures were measured on; `threads` is what XLA's CPU pool may use."""
    device = jax.devices()[0]
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count() or 1,
        "threads": machine.cores(),
        "device": f"{device.platform}: {device.device_kind}",
        "jax": jax.__version__,
        "python": platform.python_version(),
    }


def report(
    name: str, results: Mapping[str, Figures], as_json: bool, also: Figures | None = None
) -> None:
    """Print one row of figures per case, with the hardware, as a table or one JSON object.

    A table that is too wide for the terminal is shown case by case, a line for each figure.
    also: what else the figures were measured on, beside `hardware`.
    """
    machine = hardware() | dict(also or {})
    if as_json:
        print(json.dumps({"benchmark": name, "hardware": machine, "results": results}))
        return
    columns = list(dict.fromkeys(key for figures in results.values() for key in figures))
    table = Table(title=name, title_justify="left")
    table.add_column("case")
    for column in columns:
        table.add_column(column, justify="right")
    for case, figures in results.items():
        table.add_row(case, *(cell(figures.get(column, "")) for column in columns))
    console = Console()
    anywhere = console.options.update(width=10_000)
    if console.measure(table, options=anywhere).minimum <= console.width:
        console.print(table)
    else:
        for case, figures in results.items():
            print(case)
            for column, value in figures.items():
                print(f"    {column:<24} {cell(value)}")
    console.print(" | ".join(f"{key} {value}" for key, value in machine.items()), highlight=False)


def cell(value: float | int | str) -> str:
    """A figure as tables show it."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else value


def _cpu_model() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
