"""Runs every benchmark and writes one page: `python -m benchmarks [--output PAGE]`."""

import argparse
import json
import pkgutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import benchmarks
from benchmarks._harness import cell
from vertiwm_jax import atomic

_APART = {
    "bogged",
    "devices",
    "gpu",
    "identification",
    "measured_wheels",
    "recurrent_baseline",
    "skid_steered",
    "soil_adaptation",
    "soil_passes",
    "turns",
    "unseen_vehicles",
}
"""Those that need a GPU, recorded drives, trials or minutes, and what runs another one."""
_NEEDS = {
    "chrono": ("pychrono", "see docs/collect.md"),
    "torch_peer": ("torch", 'pip install -e ".[peers]"'),
}
"""Packages that some compare with, and where they come from."""


def page(found: dict[str, Any]) -> str:
    """Markdown: the hardware, then a table for each benchmark."""
    machine = next(iter(found.values()))["hardware"]
    sections = ["# Benchmarks", ", ".join(f"{key} {value}" for key, value in machine.items())]
    for name, one in found.items():
        results = one["results"]
        columns = list(dict.fromkeys(key for figures in results.values() for key in figures))
        rows = [["case", *columns], ["---"] * (1 + len(columns))]
        for case, figures in results.items():
            rows.append([case, *(cell(figures.get(column, "")) for column in columns)])
        table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
        sections += [f"## {name}", table]
    return "\n\n".join(sections) + "\n"


def main() -> None:
    arguments = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    arguments.add_argument("--output", type=Path, default=Path("benchmarks.md"))
    chosen = arguments.parse_args()
    atomic.expect_file(chosen.output)
    modules = pkgutil.iter_modules(benchmarks.__path__)
    names = [module.name for module in modules if not module.ispkg]
    found = {}
    for name in names:
        if name.startswith("_") or name in _APART:
            continue
        if name in _NEEDS and not find_spec(_NEEDS[name][0]):
            package, source = _NEEDS[name]
            print(f"{name} is left out: it needs {package} ({source})")
            continue
        print(f"{name} ...", flush=True)
        command = [sys.executable, "-m", f"benchmarks.{name}", "--json"]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        found[name] = json.loads(done.stdout.splitlines()[-1])
        chosen.output.write_text(page(found), encoding="utf-8")
    print(f"written to {chosen.output}")


if __name__ == "__main__":
    main()
