"""The closing table: policies side by side, by difficulty of the ground."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from vertiwm_jax.env.driver import Driver, Policy
from vertiwm_jax.env.navigation import NavigationEnv, NavigationParams
from vertiwm_jax.evaluation.navigation import (
    NavigationResult,
    Summary,
    evaluate,
    format_table,
)
from vertiwm_jax.rl import ground

Results = Mapping[str, NavigationResult]


def drive(
    env: NavigationEnv,
    params: NavigationParams,
    policies: Mapping[str, Policy | Driver],
    key: jax.Array,
) -> dict[str, Results]:
    """Drives all tasks of the pool with each policy; the results by difficulty of the ground."""
    print(f"driving {params.pool_size} tasks on {params.terrain.worlds} worlds ...", flush=True)
    results = {name: evaluate(env, params, policy, key) for name, policy in policies.items()}
    return by_difficulty(results, ground.difficulties(params.terrain))


def by_difficulty(results: Results, difficulty: Sequence[str]) -> dict[str, Results]:
    """Splits the episodes of each policy by the `difficulty` `[W]` of their world."""
    groups = {}
    for name in dict.fromkeys(difficulty):
        worlds = [world for world, found in enumerate(difficulty) if found == name]
        groups[name] = {
            policy: jax.tree.map(lambda x, rows=np.isin(result.world, worlds): x[rows], result)
            for policy, result in results.items()
        }
    return groups


def markdown(groups: Mapping[str, Results], reference: str) -> str:
    """A table for each group, and how many tasks that `reference` fails the others solve."""
    return "\n\n".join(_section(name, results, reference) for name, results in groups.items())


def summary(groups: Mapping[str, Results], reference: str) -> dict[str, Any]:
    """The same as plain numbers, for JSON; what has no value is None."""
    return {
        name: {
            policy: {
                **_plain(Summary.of(result)),
                "solved_of_reference_failures": _rescued(result, results[reference]),
            }
            for policy, result in results.items()
        }
        for name, results in groups.items()
    }


def _plain(row: Summary) -> dict[str, Any]:
    values = dataclasses.asdict(row)
    return {name: None if value != value else value for name, value in values.items()}


def _section(name: str, results: Results, reference: str) -> str:
    table = format_table({policy: Summary.of(result) for policy, result in results.items()})
    others = [policy for policy in results if policy != reference]
    if not others:
        return f"**{name}**\n\n{table}"
    failures = int(np.sum(~np.asarray(results[reference].success)))
    rescued = ", ".join(
        f"{policy} {_rescued(results[policy], results[reference])}" for policy in others
    )
    return (
        f"**{name}**\n\n{table}\n\nSolved of the {failures} tasks that {reference} fails: {rescued}"
    )


def _rescued(result: NavigationResult, reference: NavigationResult) -> int:
    return int(np.sum(np.asarray(result.success) & ~np.asarray(reference.success)))
