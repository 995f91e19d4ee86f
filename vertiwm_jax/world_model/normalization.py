"""Constants that bring states, commands and transitions to zero mean and unit deviation."""

from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.state import Command, VehicleState

LOCAL = np.array([3, 4, 6, 7, 8, 9, 10, 11])
"""What a vehicle knows of its state wherever it is and whichever way it faces."""
INPUTS = LOCAL.size + 2
"""Numbers in `Normalization.inputs`."""


@struct.dataclass
class Normalization:
    """Mean and standard deviation over drives; stored with a model, and never learned.

    state_mean, state_deviation: `[8]` of roll, pitch (rad), v_body (m/s), omega_body (rad/s).
    command_mean, command_deviation: `[2]` of speed (m/s) and front-wheel angle (rad).
    transition_mean, transition_deviation: `[12]` of `motion.transition`.
    """

    state_mean: jax.Array
    state_deviation: jax.Array
    command_mean: jax.Array
    command_deviation: jax.Array
    transition_mean: jax.Array
    transition_deviation: jax.Array

    @classmethod
    def unit(cls) -> Self:
        """Leaves everything in its units."""
        pairs = ((jnp.zeros(size), jnp.ones(size)) for size in (LOCAL.size, 2, 12))
        return cls(*(array for pair in pairs for array in pair))

    def inputs(self, state: VehicleState, command: Command) -> jax.Array:
        """`[..., 10]` state and command, normalized; position and yaw are left out."""
        fixed = jax.lax.stop_gradient(self)
        local = (state.vector[..., LOCAL] - fixed.state_mean) / fixed.state_deviation
        asked = (command.vector - fixed.command_mean) / fixed.command_deviation
        return jnp.concatenate([local, asked], axis=-1)

    def transition(self, normalized: jax.Array) -> jax.Array:
        """`[..., 12]` normalized to `[..., 12]` in m, rad, m/s and rad/s."""
        fixed = jax.lax.stop_gradient(self)
        return fixed.transition_mean + fixed.transition_deviation * normalized
