"""A rough world and small specialists whose weights have all moved from their first values."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.networks.specialist import NetworkSize
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model.normalization import Normalization

TINY = NetworkSize(layers=2, width=32, heads=2, hidden=48, channels=4)
CONSTANTS = Normalization(
    state_mean=jnp.array([0.0, 0.02, 2.1, 0.0, 0.0, 0.0, 0.0, 0.0]),
    state_deviation=jnp.array([0.1, 0.1, 0.8, 0.2, 0.2, 0.2, 0.2, 0.2]),
    command_mean=jnp.array([2.2, 0.0]),
    command_deviation=jnp.array([0.9, 0.15]),
    transition_mean=jnp.zeros(12),
    transition_deviation=jnp.array(
        [0.0035, 0.0025, 0.005, 0.007, 0.006, 0.002, 0.33, 0.1, 0.2, 0.2, 0.14, 0.07]
    ),
)
"""Of the size that recorded drives have."""


def rough(seed: int = 0, lift: float = 0.0, **changes) -> terrain_map.TerrainMap:
    """49 x 49 m of hills and bumps with every class of ground."""
    rng = np.random.default_rng(seed)
    x = np.arange(49)
    hills = 4 + np.sin(x / 5)[:, None] + np.cos(x / 7) + rng.uniform(-0.1, 0.1, (49, 49))
    arrays = {"elevation": hills, "semantic": rng.integers(0, 10, (12, 12)), **changes}
    return TerrainMap.from_array(arrays["elevation"] + lift, arrays["semantic"])


def driving(seed: int = 0, *batch: int) -> VehicleState:
    """Vehicles that drive somewhere on `rough`, a little tilted."""
    rng = np.random.default_rng(seed)
    low = [-8, -8, 4, -0.1, -0.1, -3, 1, -0.1, -0.1, -0.1, -0.1, -0.1]
    high = [8, 8, 6, 0.1, 0.1, 3, 3, 0.1, 0.1, 0.1, 0.1, 0.1]
    return VehicleState.from_vector(jnp.asarray(rng.uniform(low, high, (*batch, 12)), jnp.float32))


def commands(steps: int, *batch: int, seed: int = 0) -> Command:
    rng = np.random.default_rng(seed)
    vector = rng.uniform([1.0, -0.3], [4.0, 0.3], (*batch, steps, 2))
    return Command.from_vector(jnp.asarray(vector, jnp.float32))


def moved(params, seed: int = 0):
    """The parameters with noise of a tenth added to every weight of the network."""
    rng = np.random.default_rng(seed)

    def noisy(x: jax.Array) -> jax.Array:
        return jnp.asarray(x + rng.normal(0, 0.1, x.shape), jnp.float32)

    return replace(params, network=jax.tree.map(noisy, params.network))


def count(params) -> int:
    return sum(x.size for x in jax.tree.leaves(params))


def one(tree, i):
    """What stands at a place of the first axis of every leaf."""
    return jax.tree.map(lambda x: x[i], tree)


def check_batches(predict, states, controls, tolerance: float) -> None:
    """`predict(state, commands)` of B drives at once is what it gives of each, by one program."""
    alone, traces = jax.jit(predict), 0

    def counted(state, commands):
        nonlocal traces
        traces += 1
        return predict(state, commands)

    together = jax.jit(jax.vmap(counted))
    batch = together(states, controls)
    together(one(states, slice(None, None, -1)), controls)
    assert traces == 1
    for i in range(len(controls.speed)):
        expected = alone(one(states, i), one(controls, i))
        np.testing.assert_allclose(one(batch, i).vector, expected.vector, atol=tolerance)
