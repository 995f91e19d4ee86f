"""Recurrent kinodynamic fusion without its network: Eqs. 4 to 10 as pure functions (Sec. IV-C)."""

from typing import Literal, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.world_model import motion
from vertiwm_jax.world_model.perception import Glance, Perception

GateTerrain = Literal["mean", "both"]
"""Whether the gate reads the mean of both specialists' terrain features, or all of them."""
CONTEXT_SIZE: dict[GateTerrain, int] = {"mean": 68, "both": 104}
POSITION_AND_YAW = (-32, -31, -30, -27)
"""Where a context holds what depends on where the map lies: place and heading."""
COEFFICIENTS = ("planar motion", "vertical motion", "tilt", "yaw")
"""What the entries of alpha weigh."""
_GROUPS = np.array([0, 0, 1, 2, 2, 3])


@struct.dataclass
class Proposal:
    """What one specialist would do from the current state.

    increment: `[..., 6]` xi, its pose in the current body frame, m and rad.
    twist: `[..., 6]` nu, its velocities in its own body frame, m/s and rad/s.
    perception: what it has seen at the current state.
    """

    increment: jax.Array
    twist: jax.Array
    perception: Perception | Glance

    @classmethod
    def of(
        cls, state: VehicleState, proposed: VehicleState, perception: Perception | Glance
    ) -> Self:
        """From the next state that a specialist gives (Eq. 4)."""
        return cls(motion.increment(state, proposed), motion.twist(proposed), perception)


def context(
    state: VehicleState,
    command: Command,
    transformer: Proposal,
    nesam: Proposal,
    terrain: GateTerrain,
) -> jax.Array:
    """c of Eq. 5, `[..., 68]`, or `[..., 104]` with the terrain features of both specialists.

    In order: terrain features, state, command, and the increments of NeSAM and the Transformer
    with their difference, through which no gradient flows.
    """
    features = [nesam.perception.averaged, transformer.perception.averaged]
    if terrain == "mean":
        features = [0.5 * (features[0] + features[1])]
    disagreement = nesam.increment - transformer.increment
    motions = jax.lax.stop_gradient((nesam.increment, transformer.increment, disagreement))
    return jnp.concatenate([*features, state.vector, command.vector, *motions], axis=-1)


def coefficients(outputs: jax.Array) -> jax.Array:
    """`[..., 4]` outputs of the gate to alpha in (-1, 2), 0.5 for an output of 0 (Eq. 7)."""
    return 0.5 + 1.5 * jnp.tanh(outputs)


def weights(coefficients: jax.Array) -> jax.Array:
    """alpha `[..., 4]`, of planar and vertical motion, tilt and yaw, to beta `[..., 6]` (Eq. 8)."""
    return coefficients[..., _GROUPS]


def fuse(
    state: VehicleState, transformer: Proposal, nesam: Proposal, coefficients: jax.Array
) -> VehicleState:
    """The next state for alpha `[..., 4]`: the Transformer's for 0, NeSAM's for 1 (Eqs. 9, 10)."""
    beta = weights(coefficients)
    increment = transformer.increment + beta * (nesam.increment - transformer.increment)
    twist = transformer.twist + beta * (nesam.twist - transformer.twist)
    return motion.moved(state, increment, twist)
