"""The one function type of everything that moves a vehicle.

A kinematic baseline, the built-in simulator, a learned specialist, the fused model: each is a
frozen, hashable object with two pure functions of one vehicle. Batches are made by `vmap`,
trajectories by `lax.scan`; weights, maps and state are arguments.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from operator import itemgetter
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp

from vertiwm_jax.precision import float32
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap

Params = Any
History = Any
T = TypeVar("T")


class Dynamics(Protocol):
    """Moves one vehicle by 0.1 s over a terrain map.

    `init` starts the history of a vehicle that stands or drives at `state`; `step` holds
    `command` for one step and gives the next state with the history that goes with it. What a
    model perceives of the ground at a state is part of the history it returns with that state,
    as its field `features`: what the model's `see(params, terrain, state)` gives, if it has that.
    """

    def init(self, params: Params, terrain: TerrainMap, state: VehicleState) -> History: ...

    def step(
        self,
        params: Params,
        terrain: TerrainMap,
        history: History,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, History]: ...


@partial(jax.jit, static_argnums=0)
def step(dynamics: Dynamics, *given: Any) -> tuple[VehicleState, History]:
    """`dynamics.step` of what is `given`, traced once for all programs that give the same types."""
    return dynamics.step(*given)


@float32
def disagreement(history: History) -> jax.Array:
    """`[]` m between where the models went that the last step was made of; 0 of a single one.

    A sign of what none of them has learned (Kidambi et al., 2020, "MOReL").
    """
    return getattr(history, "disagreement", jnp.float32(0))


@float32
def spread(history: History) -> jax.Array:
    """`[]` m, the standard deviation of where each of an ensemble went; 0 of a single model.

    A sign of what it has not learned (Lakshminarayanan et al., 2017, "deep ensembles").
    """
    return getattr(history, "spread", jnp.float32(0))


def embedding(history: History) -> jax.Array | None:
    """`[16, 16, 36]` latents of the ground, as the model sees it at the state of `history`.

    None of a model that does not keep them.
    """
    features = getattr(history, "features", ())
    return features[0].latents if features else None


def rutted(terrain: TerrainMap, history: History) -> TerrainMap:
    """The map with the ruts that a vehicle has left, if its model remembers them."""
    return replace(terrain, ruts=getattr(history, "ruts", None))


@float32
def warm_up(
    dynamics: Dynamics,
    params: Params,
    terrain: TerrainMap,
    states: VehicleState,
    commands: Command,
) -> History:
    """The history after a recorded context: `states` leaves `[C + 1, 3]`, `commands` `[C]`.

    Each step starts from the recorded state, and looks at the ground there, so that only what the
    state does not say (wheel speeds, steering angle, past tokens) is carried along.
    """
    before, last = (jax.tree.map(itemgetter(i), states) for i in (slice(-1), -1))
    *_, history = along(dynamics, params, terrain, before, commands)
    see = getattr(dynamics, "see", None)
    if see is None:
        return history
    return replace(history, features=see(params, rutted(terrain, history), last))


@float32
def along(
    dynamics: Dynamics,
    params: Params,
    terrain: TerrainMap,
    states: VehicleState,
    commands: Command,
    read: Callable[[History], T] = lambda _: None,
) -> tuple[VehicleState, T, History]:
    """A step from each of T recorded states, leaves `[T, 3]`, with the history of those before it.

    A model looks at the ground where the drive was. commands: `[T]`.

    Returns:
        Where each step leads, leaves `[T, 3]`; what is read of the histories after them; and the
        last history, which has seen no ground yet.
    """
    see = getattr(dynamics, "see", None)

    def seeing(history: History, features: Any) -> History:
        return replace(history, features=features) if see else history

    def advance(history: History, inputs: tuple[VehicleState, Command]) -> tuple[History, Any]:
        state, command = inputs
        history = seeing(history, see and see(params, rutted(terrain, history), state))
        proposed, history = dynamics.step(params, terrain, history, state, command)
        return seeing(history, None), (proposed, read(history))

    begun = seeing(dynamics.init(params, terrain, jax.tree.map(itemgetter(0), states)), None)
    history, (proposed, found) = jax.lax.scan(advance, begun, (states, commands))
    return proposed, found, history


@float32
def rollout(
    dynamics: Dynamics,
    params: Params,
    terrain: TerrainMap,
    state: VehicleState,
    commands: Command,
    history: History = None,
) -> VehicleState:
    """Drives a vehicle in a model: open-loop prediction.

    Args:
        dynamics, params: the model, and its parameters.
        terrain: the map, with the world selected that is driven on.
        state: the first state of the vehicle, leaves `[3]`.
        commands: one a step of 0.1 s, leaves `[T]`: speed in m/s, steering angle in rad.
        history: what the model remembers of the drive before; by default that of a vehicle that
            has only just begun.

    Returns:
        The T states that follow, leaves `[T, 3]`: position in m and roll, pitch and yaw in rad in
        the frame of the world, velocity in m/s and angular velocity in rad/s in that of the body.
    """
    if history is None:
        history = dynamics.init(params, terrain, state)

    def advance(
        carry: tuple[VehicleState, History], command: Command
    ) -> tuple[tuple[VehicleState, History], VehicleState]:
        state, history = dynamics.step(params, terrain, carry[1], carry[0], command)
        return (state, history), state

    return jax.lax.scan(advance, (state, history), commands)[1]
