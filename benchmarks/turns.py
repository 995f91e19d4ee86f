"""Compares two checkouts by one benchmark, which is run in each of them in turn.

`python -m benchmarks.turns BEFORE AFTER ppo_throughput --configs ppo` says, for each figure, how
many times that of BEFORE it is in AFTER. Other programs on the machine slow both of a pair down, so
the ratio is known better than the figures.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks._harness import Figures, cell

FIGURES = "_per_s", "median_s"
"""How figures that are compared end, unless they are named."""


def run(checkout: Path, command: list[str]) -> dict[str, Figures]:
    """What a benchmark of a checkout finds, by case."""
    found = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{command[0]}", *command[1:], "--json"],
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": str(checkout.resolve())},
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return json.loads(found.stdout.splitlines()[-1])["results"]


def ratio(before: list[float], after: list[float]) -> tuple[float, float, float]:
    """Geometric mean of the pairs' ratios, and its 95 % confidence interval by Student's t."""
    logs = np.log(after) - np.log(before)
    half = stats.t.ppf(0.975, len(logs) - 1) * stats.sem(logs) if len(logs) > 1 else np.inf
    mean, low, high = np.exp([logs.mean(), logs.mean() - half, logs.mean() + half])
    return float(mean), float(low), float(high)


def main() -> None:
    arguments = argparse.ArgumentParser(prog="python -m benchmarks.turns", description=__doc__)
    arguments.add_argument("checkouts", nargs=2, type=Path, metavar=("BEFORE", "AFTER"))
    arguments.add_argument("--pairs", type=int, default=5, help="runs in each checkout")
    arguments.add_argument("--figures", nargs="+", default=FIGURES, help="ends of their names")
    arguments.add_argument("command", nargs=argparse.REMAINDER, help="benchmark and its options")
    chosen = arguments.parse_args()
    pairs: list[list[dict[str, Figures]]] = []
    for number in range(chosen.pairs):
        # Each one is first as often: what ran just before warms a machine up, or throttles it.
        order = [0, 1] if number % 2 == 0 else [1, 0]
        found = {index: run(chosen.checkouts[index], chosen.command) for index in order}
        pairs.append([found[0], found[1]])
        print(f"pair {number + 1} of {chosen.pairs}", flush=True)
        for case, figures in found[0].items():
            for name in figures:
                if not name.endswith(tuple(chosen.figures)) or name not in found[1].get(case, {}):
                    continue
                runs = [[float(one[case][name]) for one in pair] for pair in pairs]
                before, after = (list(of_all) for of_all in zip(*runs, strict=True))
                mean, low, high = ratio(before, after)
                rates = " -> ".join(cell(float(np.median(x))) for x in (before, after))
                print(f"  {case}, {name}: {rates}, {mean:.3f} ({low:.3f} to {high:.3f})")


if __name__ == "__main__":
    main()
