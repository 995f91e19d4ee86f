"""Policies of several trainings in one table, with what the paper reports (Table III) beside."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from vertiwm_jax import runs
from vertiwm_jax.evaluation import tables
from vertiwm_jax.evaluation.navigation import Summary
from vertiwm_jax.evaluation.published import DRIVING
from vertiwm_jax.evaluation.report import Results


@dataclass(frozen=True)
class TrainingCost:
    """What a training took, compilation and tests not included; timesteps are of 0.1 s."""

    seconds: float
    timesteps: int

    @classmethod
    def of(cls, run: Path) -> Self:
        """Of the training in the folder `run`, all of its sessions together."""
        columns = runs.read_columns(run)
        done, rates = columns["timesteps"], columns["timesteps_per_second"]
        each = done[-1] / len(done)
        return cls(sum(each / rate for rate in rates), int(done[-1]))


def markdown(costs: Mapping[str, TrainingCost], judged: Mapping[str, Mapping[str, Results]]) -> str:
    """A table for each simulator: costs of the trained policies, and how they drive by suite:
    successes, their mean time, and mean absolute roll and pitch."""
    return "\n\n".join(f"**{name}**\n\n{_table(costs, groups)}" for name, groups in judged.items())


def _table(costs: Mapping[str, TrainingCost], groups: Mapping[str, Results]) -> str:
    heads = ["policy", "training [min]", "steps/s", *groups, "the paper, in Chrono"]
    rows = []
    for policy in next(iter(groups.values())):
        cost = next((x for name, x in costs.items() if policy.startswith(name)), None)
        spent = ["", ""]
        if cost:
            spent = [f"{cost.seconds / 60:.1f}", f"{cost.timesteps / cost.seconds:,.0f}"]
        driven = [_cell(Summary.of(results[policy])) for results in groups.values()]
        rows.append([policy, *spent, *driven, DRIVING.get(policy, "")])
    return tables.markdown(heads, rows)


def _cell(row: Summary) -> str:
    time = f", {row.seconds:.1f} s" if row.successes else ""
    tilt = f"{math.degrees(row.abs_roll):.1f} / {math.degrees(row.abs_pitch):.1f} deg"
    return f"{row.successes}/{row.tasks}{time}, {tilt}"
