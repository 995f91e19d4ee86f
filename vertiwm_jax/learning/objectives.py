"""What a model is fitted to keep small on one window of a recorded drive."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from vertiwm_jax.dynamics import Dynamics, History, Params, along, warm_up
from vertiwm_jax.learning.losses import LossConfig, step_loss, trajectory_loss
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap

T = TypeVar("T")


Objective = Callable[[Params, TerrainMap, Windows], jax.Array]
"""The loss `[]` of one window, its leaves without the axis N, on its own world."""


@dataclass(frozen=True)
class RolloutLoss:
    """Eq. 9: the model sees the recorded context, then only commands and its own predictions.

    coefficients: reads the `[4]` fusion coefficients of a step from the history after it.
    """

    dynamics: Dynamics
    loss: LossConfig = LossConfig()
    coefficients: Callable[[History], jax.Array] | None = None

    def __call__(self, params: Params, terrain: TerrainMap, window: Windows) -> jax.Array:
        read = self.coefficients or (lambda _: None)
        predicted, coefficients = open_loop(self.dynamics, params, terrain, window, read)
        recorded = VehicleState.from_vector(window.state[window.context + 1 :])
        return trajectory_loss(self.loss, predicted, recorded, coefficients)


@dataclass(frozen=True)
class TeacherForcingLoss:
    """The mean loss of single steps, each from the recorded state; the context is one of them.

    deviation: twelve, of transitions over drives; see `calibration.normalization`.
    """

    dynamics: Dynamics
    deviation: tuple[float, ...]

    def __call__(self, params: Params, terrain: TerrainMap, window: Windows) -> jax.Array:
        before, predicted, after, _ = teacher_forced(self.dynamics, params, terrain, window)
        return jnp.mean(step_loss(jnp.asarray(self.deviation), before, predicted, after))


def teacher_forced(
    dynamics: Dynamics,
    params: Params,
    terrain: TerrainMap,
    window: Windows,
    read: Callable[[History], Any] = lambda _: None,
) -> tuple[VehicleState, VehicleState, VehicleState, Any]:
    """Single steps along one window, each from the recorded state.

    Returns:
        Where the C + K steps begin, where the model goes, and where the drive went, leaves
        `[C + K, 3]`; and what is read of the histories after the steps.
    """
    before, after = map(VehicleState.from_vector, (window.state[:-1], window.state[1:]))
    commands = Command.from_vector(window.control)
    predicted, found, _ = along(dynamics, params, terrain, before, commands, read)
    return before, predicted, after, found


def open_loop(
    dynamics: Dynamics,
    params: Params,
    terrain: TerrainMap,
    window: Windows,
    read: Callable[[History], T] = lambda _: None,
) -> tuple[VehicleState, T]:
    """The K states predicted in one window, leaves `[K, 3]`, and what is read of the histories.

    The history is warmed up on the recorded context; from its last state on, the model sees its
    own predictions and the recorded commands. No gradient flows into the context.
    """
    c, commands = window.context, Command.from_vector
    context, start = map(VehicleState.from_vector, (window.state[: c + 1], window.state[c]))
    history = warm_up(dynamics, params, terrain, context, commands(window.control[:c]))

    def advance(
        carry: tuple[VehicleState, History], command: Command
    ) -> tuple[tuple[VehicleState, History], tuple[VehicleState, T]]:
        state, history = dynamics.step(params, terrain, carry[1], carry[0], command)
        return (state, history), (state, read(history))

    history = jax.lax.stop_gradient(history)
    return jax.lax.scan(advance, (start, history), commands(window.control[c:]))[1]
