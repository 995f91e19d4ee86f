"""Constants that bring states and commands to zero mean and unit deviation."""

from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.learning.dataset import Drives

_LOCAL = np.array([3, 4, 6, 7, 8, 9, 10, 11])
"""What a vehicle knows of its state wherever it is and whichever way it faces."""
_CONSTANT = 1e-6
"""Deviation below which a quantity counts as constant."""


@struct.dataclass
class Normalisation:
    """Mean and standard deviation over drives; stored with a model.

    state_mean, state_deviation: `[8]` of roll, pitch (rad), v_body (m/s), omega_body (rad/s).
    command_mean, command_deviation: `[2]` of speed (m/s) and front-wheel angle (rad).
    """

    state_mean: jax.Array
    state_deviation: jax.Array
    command_mean: jax.Array
    command_deviation: jax.Array

    @classmethod
    def of(cls, drives: Drives) -> Self:
        """Over all valid steps; a constant quantity gets the deviation 1."""
        valid = np.arange(drives.state.shape[1]) <= np.asarray(drives.length)[:, None]
        state = np.asarray(drives.state, np.float64)[valid][:, _LOCAL]
        control = np.asarray(drives.control, np.float64)[valid[:, 1:]]
        return cls(*_moments(state), *_moments(control))

    def state(self, state: jax.Array) -> jax.Array:
        """`[..., 12]` to `[..., 8]`, normalised; position and yaw are left out."""
        return (state[..., _LOCAL] - self.state_mean) / self.state_deviation

    def command(self, control: jax.Array) -> jax.Array:
        """`[..., 2]` to `[..., 2]`, normalised."""
        return (control - self.command_mean) / self.command_deviation


def _moments(values: np.ndarray) -> tuple[jax.Array, jax.Array]:
    deviation = values.std(axis=0)
    deviation = np.where(deviation > _CONSTANT, deviation, 1)
    return jnp.asarray(values.mean(axis=0), jnp.float32), jnp.asarray(deviation, jnp.float32)
