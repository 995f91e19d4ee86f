"""How often a policy fails within seconds, and whether what foretells it can be believed."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np

from vertiwm_jax import atomic
from vertiwm_jax.config import Count, settings
from vertiwm_jax.env import suites
from vertiwm_jax.env.agent import Policy
from vertiwm_jax.env.suites import Tasks
from vertiwm_jax.evaluation.navigation import wilson
from vertiwm_jax.evaluation.tables import Row, markdown, write
from vertiwm_jax.figures import line, sheet, style
from vertiwm_jax.rl import experiment, policy
from vertiwm_jax.rl.experiment import TaskConfig
from vertiwm_jax.rl.risk import SECONDS, STANDING, Moments, learn, watch
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain.map import TerrainMap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EDGES = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 1.0)
"""Between foretold probabilities that are looked at apart."""
_EVERY = 10  # steps between the moments that are learned from
_WINDOW = round(SECONDS / STEP_SECONDS)
_log = logging.getLogger(__name__)


@settings
class RiskTest:
    """Learn how likely a policy rolls over, collides or stands still within 3 s, and test that on
    worlds that it was not trained on.

    It drives in the built-in simulator. What was learned is kept in the policy's folder.
    """

    policy: Path
    """Folder of a training run."""
    suite_worlds: Count = 20
    """Procedural worlds of each suite to test on, where the policy did not learn on given maps."""
    starts: Count = 4500
    """Random tasks to test on, besides those across the circle of every world."""
    output: Path | None = None
    """Folder for the table and a picture."""

    def run(self) -> str:
        """Learns, tests, and writes what `output` asks for; returns tables as Markdown."""
        seeds = policy.load_policy(self.policy).config.seeds
        policies = [policy.load_policy(self.policy, seed) for seed in range(seeds)]
        atomic.expect_folder(self.policy)
        config = experiment.load(self.policy / "config.yaml")
        given = experiment.training_ground(config)[:2]
        risks = []
        for seed, trained in enumerate(policies):
            moments = _watched(config, *given, trained.acting, _EVERY)
            risks.append(learn(moments, trained.config.risk_network, jax.random.key(seed)))
        policy.save_risks(self.policy, risks)

        ground = replace(config.ground, suite_worlds=self.suite_worlds, starts=self.starts)
        config = replace(config, ground=ground)
        terrain, driven = experiment.held_out(config), config.driven.vehicle
        pool = suites.training_tasks(ground, terrain, driven, config.key("testing"))
        tested = {}
        for seed, (trained, risk) in enumerate(zip(policies, risks, strict=True)):
            # One window after the other, so that each second of driving counts once.
            moments = _watched(config, terrain, pool, trained.acting, _WINDOW)
            name = config.name if seeds == 1 else f"{config.name}, seed {seed}"
            tested[name] = np.asarray(risk(moments.seen)), moments.failed
        parts = [
            f"**{name}**\n\n{markdown(rows(*found))}\n\n{told(*found)}"
            for name, found in tested.items()
        ]
        text = "\n\n".join(parts)
        if self.output:
            write(self.output, {"risk.md": text + "\n", "risk.png": picture(tested)})
        return text


def _watched(
    config: TaskConfig, terrain: TerrainMap, pool: Tasks, agent: Policy, every: int
) -> Moments:
    """Moments of the policy in the built-in simulator, on all tasks of a pool."""
    env, task = experiment.environment(config, "builtin", terrain, pool)
    _log.info("driving %s tasks on %d worlds ...", f"{task.pool_size:,}", terrain.worlds)
    return watch(env, task, agent, config.key("testing"), every)


def rows(probability: np.ndarray, failed: np.ndarray) -> list[Row]:
    """A row for each range of the foretold probabilities of N windows: how many of them failed."""
    return [
        {
            "foretold": f"{EDGES[number]:.1%}-{EDGES[number + 1]:.1%}",
            "mean": f"{mean:.2%}",
            "windows": count,
            "failed": f"{share:.2%}",
            "95 %": "{:.2%}-{:.2%}".format(*interval),
            "failed / foretold": f"{share / mean:.2f}",
        }
        for number, count, mean, share, interval in _ranges(probability, failed)
    ]


def told(probability: np.ndarray, failed: np.ndarray) -> str:
    """All N windows in a sentence."""
    base = failed.mean()
    text = (
        f"{len(failed):,} windows of {SECONDS:g} s; {failed.sum():,} ({base:.2%}) have a rollover, "
        f"a collision, or a vehicle that stands still for {STANDING:g} s."
    )
    if 0 < base < 1:
        skill = 1 - np.mean((probability - failed) ** 2) / (base * (1 - base))
        text += f" Brier skill over this share: {skill:.2f}."
    return text


def picture(tested: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """Draws how many windows failed over what was foretold, with 95 % intervals, by policy."""
    with style():
        figure = sheet(4.6, 4.4)
        axes = figure.subplots()
        ends = np.array([EDGES[1] / 3, 1.0])
        axes.fill_between(ends, ends / 2, 2 * ends, color="0.92", label="within a factor of 2")
        axes.plot(ends, ends, color="0.6", linewidth=0.8)
        for i, (name, (probability, failed)) in enumerate(tested.items()):
            found = zip(*_ranges(probability, failed), strict=True)
            _, _, foretold, share, interval = map(np.array, found)
            around = np.abs(interval - share[:, None]).T
            color, _ = line(i)
            axes.errorbar(foretold, share, around, fmt="o", color=color, label=name, capsize=2)
        axes.set(
            xlabel=f"foretold probability of a failure within {SECONDS:g} s",
            ylabel="share of windows that had one",
            xscale="log",
            yscale="log",
            xlim=ends,
            ylim=ends,
        )
        axes.legend(loc="upper left")
    return figure


def _ranges(probability: np.ndarray, failed: np.ndarray) -> list[tuple]:
    """Of each range with windows: number, windows, mean probability, share that failed, interval.

    Intervals are of 95 %, after Wilson.
    """
    range_of = np.digitize(probability, EDGES[1:-1])
    found = []
    for number in np.unique(range_of):
        some, part = failed[range_of == number], probability[range_of == number]
        means = float(part.mean()), float(some.mean())
        found.append((int(number), len(some), *means, wilson(some)))
    return found
