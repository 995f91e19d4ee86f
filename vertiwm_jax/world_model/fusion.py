"""What the gates read and how their answers weigh both specialists (Sec. IV-C, Eqs. 4 to 7)."""

from dataclasses import replace
from typing import Any, Literal, Self, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.networks.gate import HIDDEN, Gate
from vertiwm_jax.state import Command, VehicleState

GateTerrain = Literal["mean", "both"]
"""Whether gates read the mean of both specialists' terrain features, or all of them."""
Coefficients = Literal["grouped", "scalar"]
"""One coefficient each for planar and vertical motion, tilt and yaw; or a single one."""
CONTEXT_SIZE: dict[GateTerrain, int] = {"mean": 68, "both": 104}
DIFFERENCE = slice(-6, None)
"""Where a context holds d, the difference of the increments that both specialists propose."""
POSITION_AND_YAW = (-32, -31, -30, -27)
"""Where it holds what depends on where the map lies: place and heading."""
COEFFICIENTS = ("planar motion", "vertical motion", "tilt", "yaw")
"""What the entries of alpha weigh."""
_GROUPS = np.array([0, 0, 1, 2, 2, 3])
_GATE = Gate()


@struct.dataclass
class GateParams:
    """G gates, and constants that bring their context to unit size: they read (c - mean) scale.

    A component of scale 0 is left out. Zero mean and unit scale everywhere are the paper's, and so
    is a single gate.

    network: of `networks.Gate`, leaves `[G, ...]`; mean, scale: `[C]`.
    """

    network: Any
    mean: jax.Array
    scale: jax.Array

    @classmethod
    def untrained(cls, key: jax.Array, terrain: GateTerrain, gates: int) -> Self:
        """Gates that weigh both specialists equally.

        Place and heading are left out of their context, lest they learn maps by heart.
        """
        mean = jnp.zeros(CONTEXT_SIZE[terrain])
        scale = jnp.ones_like(mean).at[jnp.array(POSITION_AND_YAW)].set(0.0)
        keys = jax.random.split(key, gates)
        network = jax.vmap(lambda key: _GATE.init(key, mean, jnp.zeros(HIDDEN)))(keys)
        return cls(network, mean, scale)

    def __len__(self) -> int:
        """G."""
        return len(jax.tree.leaves(self.network)[0])

    def only(self, number: int) -> Self:
        """One of them."""
        return replace(self, network=jax.tree.map(lambda x: x[number : number + 1], self.network))

    def beside(self, *others: "GateParams") -> Self:
        """These and others, with the constants of these."""
        networks = [gates.network for gates in (self, *others)]
        return replace(self, network=jax.tree.map(lambda *x: jnp.concatenate(x), *networks))


def context(
    terrain: GateTerrain,
    by_nesam: jax.Array,
    by_transformer: jax.Array,
    state: VehicleState,
    command: Command,
    xi_nesam: jax.Array,
    xi_transformer: jax.Array,
) -> jax.Array:
    """c of Eq. 4, `[68]`, or `[104]` with the terrain features of both specialists.

    In order: terrain features `[36]` of each, state, command, and the increments `[6]` of NeSAM
    and the Transformer with their difference d, through which no gradient flows.
    """
    features = [by_nesam, by_transformer]
    if terrain == "mean":
        features = [0.5 * (by_nesam + by_transformer)]
    motions = jax.lax.stop_gradient((xi_nesam, xi_transformer, xi_nesam - xi_transformer))
    return jnp.concatenate([*features, state.vector, command.vector, *motions])


def run_gates(
    gates: GateParams, context: jax.Array, hidden: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Outputs `[G, 4]` and next memory `[G, 64]` of all gates for one context (Eq. 5)."""
    mean, scale = jax.lax.stop_gradient((gates.mean, gates.scale))
    seen = (context - mean) * scale
    found = jax.vmap(lambda network, hidden: _GATE.apply(network, seen, hidden))(
        gates.network, hidden
    )
    return cast(tuple[jax.Array, jax.Array], found)


def coefficients(outputs: jax.Array, kind: Coefficients) -> jax.Array:
    """`[..., 4]` outputs of gates to alpha in (-1, 2), 0.5 for an output of 0 (Eq. 6)."""
    if kind == "scalar":
        outputs = jnp.broadcast_to(jnp.mean(outputs, axis=-1, keepdims=True), outputs.shape)
    return 0.5 + 1.5 * jnp.tanh(outputs)


def weights(coefficients: jax.Array) -> jax.Array:
    """alpha `[..., 4]`, of planar and vertical motion, tilt and yaw, to beta `[..., 6]` (Eq. 7)."""
    return coefficients[..., _GROUPS]
