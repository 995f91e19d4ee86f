"""How often a bogged vehicle frees itself, in the built-in simulator, on worlds of the hard suite.

A start is bogged if the vehicle moves less than 1 m in 10 s of full speed ahead, however it steers.
It has freed itself if within 15 s it gets 5 m away without rolling over. `--policies RUN ...` adds
trained policies to the controllers and to MPPI, which plans inside NeSAM and, for the most that
planning can gain, inside the simulator of the test itself.
"""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from benchmarks._harness import Figures, parser, report
from vertiwm_jax.env import suites
from vertiwm_jax.env.agent import Agent, Policy
from vertiwm_jax.env.controllers import LookAhead
from vertiwm_jax.env.episodes import NavigationResult, run_episodes
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.suites import GroundConfig, Tasks
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.models.registry import load_model
from vertiwm_jax.planning.mppi import MPPI
from vertiwm_jax.rl.policy import load_policy
from vertiwm_jax.terrain.map import TerrainMap

WORLDS = 12
CANDIDATES = 28
"""Places that are tried for each start that is wanted."""
STEERING = np.linspace(-1.0, 1.0, 5)
STEEPEST = np.radians(30)
"""Roll and pitch of a start."""
FORWARDS = NavigationConfig(horizon_seconds=15.0, stuck_seconds=20.0)
BOTH_WAYS = replace(FORWARDS, speed_range=(-3.0, 5.0))


@struct.dataclass
class Held:
    """One action `[2]` all the time."""

    action: jax.Array

    def __call__(self, observation: jax.Array, key: jax.Array) -> jax.Array:
        return self.action


def driven(
    config: NavigationConfig, terrain: TerrainMap, tasks: Tasks, *drivers: Policy | Agent
) -> list[NavigationResult]:
    """All tasks, by each driver."""
    env, vehicle = NavigationEnv(Simulator(), config), load_vehicle()
    task = env.make_params(chrono_like(vehicle), terrain, tasks, vehicle)
    return [run_episodes(env, task, driver, jax.random.key(0)) for driver in drivers]


def bogged(terrain: TerrainMap, number: int, key: jax.Array) -> Tasks:
    """The first so many bogged starts among random poses; goals are 30 m straight ahead."""
    keys, count = jax.random.split(key), CANDIDATES * number
    start = jax.random.uniform(keys[0], (count, 2), minval=-25.0, maxval=25.0)
    yaw = jax.random.uniform(keys[1], (count,), minval=-np.pi, maxval=np.pi)
    goal = start + 30 * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
    tasks = Tasks(jnp.arange(count, dtype=jnp.int32) % terrain.worlds, start, yaw, goal)
    ahead = (Held(jnp.array([1.0, steering])) for steering in STEERING)
    stays = np.ones(count, bool)
    for found in driven(FORWARDS, terrain, tasks, *ahead):
        stays &= np.max(np.abs(found.rpy[:, 0, :2]), axis=-1) < STEEPEST
        stays &= np.linalg.norm(found.position[:, 100] - found.position[:, 0], axis=-1) < 1.0
    return jax.tree.map(lambda x: x[np.flatnonzero(stays)[:number]], tasks)


def freed(found: NavigationResult) -> Figures:
    """How many got away."""
    away = np.linalg.norm(found.position - found.position[:, :1], axis=-1).max(axis=1) >= 5.0
    rolled = np.asarray(found.ending) == TerminationReason.ROLLED_OVER
    return {
        "bogged": len(away),
        "freed": int(np.sum(away & ~rolled)),
        "rolled over": int(np.sum(rolled)),
    }


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--policies", type=Path, nargs="*", default=[])
    options.add_argument("--number", type=int, default=100, help="bogged starts")
    options.add_argument("--seed", type=int, default=0)
    chosen = options.parse_args()
    key = jax.random.key(chosen.seed)
    terrain = suites.suite_worlds(GroundConfig(suites=("hard",), suite_worlds=WORLDS), key)
    tasks = bogged(terrain, chosen.number, key)
    drivers: dict[str, tuple[NavigationConfig, Policy | Agent]] = {
        "look ahead, forwards only": (FORWARDS, LookAhead(FORWARDS)),
        "look ahead": (BOTH_WAYS, LookAhead(BOTH_WAYS)),
    }
    for name in ("nesam", "builtin"):
        model, params = load_model(name)
        planner = MPPI(env=NavigationEnv(model, BOTH_WAYS), dynamics=params)
        drivers[f"MPPI in {name}"] = BOTH_WAYS, planner
    for run in chosen.policies:
        policy = load_policy(run)
        patient = replace(policy.task, horizon_seconds=15.0, stuck_seconds=20.0)
        drivers[str(run)] = patient, policy.acting
    results = {
        name: freed(driven(config, terrain, tasks, driver)[0])
        for name, (config, driver) in drivers.items()
    }
    report("bogged", results, chosen.json)


if __name__ == "__main__":
    main()
