"""Constants of models that are measured on recorded drives before anything is learned."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.learning.dataset import Drives
from vertiwm_jax.learning.objectives import teacher_forced
from vertiwm_jax.learning.problem import driven_in
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model import motion
from vertiwm_jax.world_model.alone import Alone
from vertiwm_jax.world_model.fusion import POSITION_AND_YAW
from vertiwm_jax.world_model.nesam import Nesam
from vertiwm_jax.world_model.normalization import LOCAL, Normalization
from vertiwm_jax.world_model.verti_wm import VertiWM, VertiWMParams

NUDGE = 0.05
"""Change of velocities, m/s and rad/s, by which is measured how physics answers."""
_CONSTANT = 1e-6
"""Deviation below which a quantity counts as constant."""


def normalization(drives: Drives) -> Normalization:
    """Over all valid steps; a constant quantity gets the deviation 1."""
    state, length = np.asarray(drives.state), np.asarray(drives.length)[:, None]
    valid = np.arange(state.shape[1]) <= length
    stepped = valid[:, 1:]
    before, after = (
        VehicleState.from_vector(jnp.asarray(x[stepped])) for x in (state[:, :-1], state[:, 1:])
    )
    return Normalization(
        *_moments(state[valid][:, LOCAL]),
        *_moments(np.asarray(drives.control)[stepped]),
        *_moments(np.asarray(motion.transition(before, after))),
    )


def nesam_constants(
    nesam: Nesam,
    params: VertiWMParams,
    terrain: TerrainMap,
    windows: Windows,
    vehicles: Vehicle | None = None,
) -> VertiWMParams:
    """The parameters with NeSAM's `correction_scale` and `response`, measured on windows.

    vehicles: of `WindowData`.
    """
    constants = params.nesam
    assert constants is not None

    def one(window: Windows) -> tuple[jax.Array, jax.Array]:
        ground = terrain.select(window.world)
        own = driven_in(params, vehicles, window.world)
        physics = constants.physics(own.vehicle)
        before, _, after, (proposed, memories) = teacher_forced(
            Alone(nesam),
            own,
            ground,
            window,
            lambda history: (history.specialist.physics, history.specialist.simulator),
        )
        # The last but one memory goes with the last state.
        memory = jax.tree.map(lambda x: x[-2], memories)
        start = jax.tree.map(lambda x: x[-1], before)
        command = Command.from_vector(window.control[-1])

        def answer(twist: jax.Array) -> jax.Array:
            moving = replace(start, velocity=twist[:3], angular_velocity=twist[3:])
            later, _ = nesam.simulator.step(physics, ground, memory, moving, command)
            return motion.transition(moving, later)

        # Differences over about what physics misses: at a point, contacts are either on or off.
        nudges = NUDGE * jnp.concatenate([jnp.eye(6), -jnp.eye(6)])
        above, below = jnp.split(jax.vmap(answer)(motion.twist(start) + nudges), 2)
        return jax.vmap(motion.difference)(proposed, after), (above - below).T / (2 * NUDGE)

    missed, response = jax.vmap(one)(windows)
    # A few crashes would make up most of the squares.
    missed = jnp.abs(missed.reshape(-1, 12))
    missed = jnp.minimum(missed, jnp.percentile(missed, 99.0, axis=0))
    scale, response = jnp.sqrt(jnp.mean(missed**2, axis=0)), jnp.median(response, axis=0)
    return replace(params, nesam=replace(constants, correction_scale=scale, response=response))


def gate_constants(
    model: VertiWM,
    params: VertiWMParams,
    terrain: TerrainMap,
    windows: Windows,
    vehicles: Vehicle | None = None,
) -> VertiWMParams:
    """The parameters with the constants of the gates' context, measured on windows.

    vehicles: of `WindowData`.
    """
    assert params.gate is not None

    @jax.jit
    @partial(jax.vmap, in_axes=(None, None, 0))
    def measured(params: VertiWMParams, terrain: TerrainMap, window: Windows) -> jax.Array:
        ground, own = terrain.select(window.world), driven_in(params, vehicles, window.world)
        return teacher_forced(model, own, ground, window, lambda history: history.context)[3]

    context = measured(params, terrain, windows)
    context = context.reshape(-1, context.shape[-1])
    deviation = jnp.std(context, axis=0)
    scale = jnp.where(deviation > _CONSTANT, 1 / jnp.maximum(deviation, _CONSTANT), 0.0)
    scale = scale.at[jnp.array(POSITION_AND_YAW)].set(0.0)
    return replace(params, gate=replace(params.gate, mean=jnp.mean(context, axis=0), scale=scale))


def _moments(values: np.ndarray) -> tuple[jax.Array, jax.Array]:
    values = values.astype(np.float64)
    deviation = values.std(axis=0)
    deviation = np.where(deviation > _CONSTANT, deviation, 1)
    return jnp.asarray(values.mean(axis=0), jnp.float32), jnp.asarray(deviation, jnp.float32)
