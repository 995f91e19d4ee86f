"""How well policies drive: success, time, roll and pitch over a set of tasks, as a table."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Self

import jax
import numpy as np

from vertiwm_jax.env.agent import Agent, Policy
from vertiwm_jax.env.episodes import NavigationResult, run_episodes
from vertiwm_jax.env.navigation import make_env
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.mechanics.vehicle import HMMWV, Vehicle
from vertiwm_jax.models.registry import Imagined
from vertiwm_jax.rl.policy import Policy as Trained
from vertiwm_jax.terrain.map import TerrainMap


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
        W * `pairs` episodes: how they ended, their duration, tilt and path. `Summary.of` of this
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


@dataclasses.dataclass(frozen=True)
class Summary:
    """One row of a table of policies.

    tasks, successes: counts; success_interval: 95 % Wilson interval of the rate.
    seconds, seconds_deviation: mean and standard deviation over successes; NaN without any.
    abs_roll, abs_pitch: rad, mean over all steps of all episodes.
    driven: m, mean over all episodes.
    endings: how often each ending came, by name.
    """

    tasks: int
    successes: int
    success_interval: tuple[float, float]
    seconds: float
    seconds_deviation: float
    abs_roll: float
    abs_pitch: float
    driven: float
    endings: Mapping[str, int]

    @classmethod
    def of(cls, result: NavigationResult) -> Self:
        """The summary of some episodes."""
        success = np.asarray(result.success)
        steps = np.asarray(result.steps)
        seconds = np.asarray(result.seconds)[success]
        counts = np.bincount(np.asarray(result.ending), minlength=len(TerminationReason))
        return cls(
            tasks=len(success),
            successes=int(success.sum()),
            success_interval=wilson_interval(int(success.sum()), len(success)),
            seconds=float(seconds.mean()) if len(seconds) else math.nan,
            seconds_deviation=float(seconds.std()) if len(seconds) else math.nan,
            abs_roll=float(np.average(result.abs_roll, weights=steps)),
            abs_pitch=float(np.average(result.abs_pitch, weights=steps)),
            driven=float(np.mean(result.driven)),
            endings={e.name.lower(): int(counts[e]) for e in TerminationReason if counts[e]},
        )


def wilson_interval(successes: int, trials: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's score interval of a success rate, 95 % by default.

    Wilson (1927), Probable inference, the law of succession, and statistical inference.
    """
    rate = successes / trials
    middle = rate + z * z / (2 * trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def format_table(rows: Mapping[str, Summary]) -> str:
    """A Markdown table with the paper's columns, one row for each named policy."""
    header = ["policy", "success", "95 %", "time [s]", "roll [deg]", "pitch [deg]", "driven [m]"]
    cells: list[tuple[str, ...]] = [(*header, "endings")]
    for name, row in rows.items():
        low, high = (round(100 * bound) for bound in row.success_interval)
        time = f"{row.seconds:.1f} ± {row.seconds_deviation:.1f}" if row.successes else "-"
        endings = ", ".join(f"{ending} {count}" for ending, count in row.endings.items())
        cells.append(
            (
                name,
                f"{row.successes}/{row.tasks}",
                f"{low}-{high}",
                time,
                f"{math.degrees(row.abs_roll):.2f}",
                f"{math.degrees(row.abs_pitch):.2f}",
                f"{row.driven:.1f}",
                endings,
            )
        )
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    cells.insert(1, tuple("-" * width for width in widths))
    lines = (
        " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        for row in cells
    )
    return "\n".join(f"| {line} |" for line in lines)
