"""How well policies drive: success, time, roll and pitch over a set of tasks, as a table."""

import math
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from vertiwm_jax.env.agent import Agent, Policy
from vertiwm_jax.env.episodes import NavigationResult, run_episodes
from vertiwm_jax.env.navigation import make_env
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.evaluation.tables import markdown
from vertiwm_jax.mechanics.vehicle import HMMWV, Vehicle
from vertiwm_jax.models.registry import Imagined
from vertiwm_jax.precision import float32
from vertiwm_jax.rl.policy import Policy as Trained
from vertiwm_jax.terrain.map import TerrainMap


@float32
def evaluate(
    agent: Agent | Policy | Trained,
    terrain: TerrainMap | None = None,
    *,
    model: Imagined = "builtin",
    vehicle: str | Vehicle | None = None,
    pairs: int = 10,
    seed: int = 0,
) -> NavigationResult:
    """Tests how well an agent drives across maps.

    Args:
        agent: a trained policy, an agent, or any function of an observation and a key.
        terrain: W worlds; by default two procedural ones of each of the three suites.
        model: what moves the vehicle, see `load_model`.
        vehicle: which it is; by default that of the policy's training, or the HMMWV.
        pairs: tasks in a world.
        seed: draws the default worlds, and decides what is random of the agent.

    Returns:
        W * `pairs` episodes: how they ended, their duration, tilt and path. `summary` of this
        module sums them up.

    Raises:
        TaskError: a task cannot be driven on the map.
        ConfigError, CheckpointError: there is no such vehicle, or no such model.
    """
    config = NavigationConfig()
    if isinstance(agent, Trained):
        config, vehicle = agent.task, vehicle or agent.config.vehicle.vehicle
        agent = agent.acting
    env, task = make_env(
        terrain, model, vehicle=vehicle or HMMWV, config=config, pairs=pairs, seed=seed
    )
    return run_episodes(env, task, agent, jax.random.key(seed))


def summary(result: NavigationResult) -> dict[str, Any]:
    """Sums up episodes as plain numbers, for tables and for JSON.

    Returns:
        tasks, successes: counts.
        success_interval: 95 % Wilson interval of the success rate.
        seconds, seconds_deviation: mean and standard deviation over successes; None without any.
        abs_roll, abs_pitch: rad, mean over all steps of all episodes.
        driven: m, mean over all episodes.
        endings: how often each termination reason came, by name.
    """
    success, steps = np.asarray(result.success), np.asarray(result.steps)
    successes, seconds = int(success.sum()), np.asarray(result.seconds)[success]
    counts = np.bincount(np.asarray(result.ending), minlength=len(TerminationReason))
    return {
        "tasks": len(success),
        "successes": successes,
        "success_interval": wilson(success),
        "seconds": float(seconds.mean()) if successes else None,
        "seconds_deviation": float(seconds.std()) if successes else None,
        "abs_roll": float(np.average(result.abs_roll, weights=steps)),
        "abs_pitch": float(np.average(result.abs_pitch, weights=steps)),
        "driven": float(np.mean(result.driven)),
        "endings": {e.name.lower(): int(counts[e]) for e in TerminationReason if counts[e]},
    }


def wilson(holds: np.ndarray) -> tuple[float, float]:
    """The 95 % interval, after Wilson, of how often something holds, by samples `[N]` of it."""
    from scipy.stats import binomtest

    interval = binomtest(int(holds.sum()), len(holds)).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def format_table(summaries: Mapping[str, Mapping[str, Any]]) -> str:
    """A Markdown table of summaries by policy, with the paper's columns."""
    rows = []
    for policy, x in summaries.items():
        low, high = (round(100 * bound) for bound in x["success_interval"])
        time = f"{x['seconds']:.1f} ± {x['seconds_deviation']:.1f}" if x["successes"] else "-"
        rows.append(
            {
                "policy": policy,
                "success": f"{x['successes']}/{x['tasks']}",
                "95 %": f"{low}-{high}",
                "time [s]": time,
                "roll [deg]": f"{math.degrees(x['abs_roll']):.2f}",
                "pitch [deg]": f"{math.degrees(x['abs_pitch']):.2f}",
                "driven [m]": f"{x['driven']:.1f}",
                "endings": ", ".join(f"{name} {n}" for name, n in x["endings"].items()),
            }
        )
    return markdown(rows)
