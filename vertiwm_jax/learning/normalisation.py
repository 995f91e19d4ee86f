"""Normalisation constants of recorded drives."""

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.learning.dataset import Drives
from vertiwm_jax.state import VehicleState
from vertiwm_jax.world_model import motion
from vertiwm_jax.world_model.normalisation import LOCAL, Normalisation

_CONSTANT = 1e-6
"""Deviation below which a quantity counts as constant."""


def measure(drives: Drives) -> Normalisation:
    """Over all valid steps; a constant quantity gets the deviation 1."""
    state, length = np.asarray(drives.state), np.asarray(drives.length)[:, None]
    valid = np.arange(state.shape[1]) <= length
    stepped = valid[:, 1:]
    before, after = (
        VehicleState.from_vector(jnp.asarray(x[stepped])) for x in (state[:, :-1], state[:, 1:])
    )
    return Normalisation(
        *_moments(state[valid][:, LOCAL]),
        *_moments(np.asarray(drives.control)[stepped]),
        *_moments(np.asarray(motion.transition(before, after))),
    )


def _moments(values: np.ndarray) -> tuple[jax.Array, jax.Array]:
    values = values.astype(np.float64)
    deviation = values.std(axis=0)
    deviation = np.where(deviation > _CONSTANT, deviation, 1)
    return jnp.asarray(values.mean(axis=0), jnp.float32), jnp.asarray(deviation, jnp.float32)
