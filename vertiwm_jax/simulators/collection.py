"""Drives that are recorded in a simulator, and the files that keep them."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.env.agent import Policy, Reactive
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.tasks import Tasks
from vertiwm_jax.learning import schema
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.perception.features import Encoders
from vertiwm_jax.simulators import excitation
from vertiwm_jax.simulators.driving import Drive, Ending, Pilot, drive
from vertiwm_jax.simulators.excitation import MARGIN, within
from vertiwm_jax.simulators.following import AgentPilot, Followed
from vertiwm_jax.simulators.protocol import Simulator
from vertiwm_jax.terrain.map import TerrainMap

LEAST_UPRIGHT = 0.3
"""Cosine of the tilt below which a vehicle has rolled over."""
LARGEST_SPEED = 30.0
"""m/s, beyond which a simulation has diverged."""


def record(
    simulator: Simulator,
    terrain: TerrainMap,
    start: Sequence[float],
    pilot: Pilot,
    steps: int,
) -> Drive:
    """Drives until `steps` are done, or the vehicle leaves the map or rolls over.

    terrain: what the simulator drives on. A state that diverged is left out.
    """
    low, high = within(terrain, MARGIN)
    return drive(simulator, start, pilot, steps, partial(_ending, low, high))


def to_goals(
    policy: Policy,
    config: NavigationConfig,
    encoders: Encoders | None,
    vehicle: Vehicle,
    terrain: TerrainMap,
    start: Sequence[float],
    rng: np.random.Generator,
) -> AgentPilot:
    """A policy as the pilot of a drive from goal to goal on the selected world.

    Args:
        policy: what drives.
        config: the task that it has learned.
        encoders: what it sees embeddings of the ground by; None if it sees none.
        vehicle: what is driven.
        terrain: where.
        start: x, y, m, and yaw, rad.
        rng: draws the goals.
    """
    env = NavigationEnv(Followed(), replace(config, settle_steps=0))
    next_goal = partial(excitation.next_goal, rng, terrain)
    place = jnp.asarray([start], jnp.float32)
    goal = jnp.asarray(next_goal(np.asarray(place[0, :2]))[None, :2])
    one = Tasks(jnp.reshape(terrain.world, 1), place[:, :2], place[:, 2], goal)
    task = env.make_params(jnp.zeros(12), terrain, one, vehicle, encoders)
    at_start = jax.tree.map(lambda x: x[0], task.starts)
    # No learned policy is random.
    return AgentPilot(env, task, Reactive(policy), at_start, jax.random.key(0), next_goal)


def write(
    path: Path, drives: Sequence[Drive], steps: int, meta: dict[str, Any], vehicle: Vehicle
) -> None:
    """A file of the schema with K drives of a vehicle, each filled up to `steps`.

    meta: holds "map", the file name of the terrain map.
    """
    arrays = schema.join([_arrays(drive) for drive in drives], steps)
    arrays["ending"] = np.array([drive.ending for drive in drives])
    schema.write(path, arrays, meta, vehicle.wheel_position)


def _arrays(drive: Drive) -> dict[str, np.ndarray]:
    """Arrays of the schema `[T + 1, ...]`, of the control `[T, 2]`."""
    seen = jax.tree.map(lambda *x: np.stack(x), *drive.observations)
    arrays = {"state": seen.state, "control": drive.control, "wheel_class": seen.wheel_class}
    known = {name: getattr(seen.auxiliary, name) for name in schema.AUXILIARY}
    return arrays | {name: array for name, array in known.items() if array is not None}


def _ending(low: np.ndarray, high: np.ndarray, state: np.ndarray) -> Ending | None:
    """Why a drive cannot go on, if it cannot; low, high: `[2]` m, where it may be."""
    if not np.isfinite(state).all() or np.linalg.norm(state[6:9]) > LARGEST_SPEED:
        return "diverged"
    if ((state[:2] < low) | (state[:2] > high)).any():
        return "left the map"
    if np.cos(state[3]) * np.cos(state[4]) < LEAST_UPRIGHT:
        return "rolled over"
    return None
