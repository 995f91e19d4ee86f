"""What a model is fitted to keep small on one window of a recorded drive."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import jax
import jax.numpy as jnp

from vertiwm_jax.dynamics import Dynamics, History, Params, along, warm_up
from vertiwm_jax.learning.losses import LossConfig, step_loss, trajectory_loss
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap

T = TypeVar("T")


class Objective(Protocol):
    """The loss of one window, its leaves without the axis N, on its own world."""

    def __call__(self, params: Params, terrain: TerrainMap, window: Windows) -> jax.Array: ...


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
        recorded = VehicleState.from_vector(window.state)
        before, after = _at(recorded, slice(None, -1)), _at(recorded, slice(1, None))
        commands = Command.from_vector(window.control)
        predicted, _ = along(self.dynamics, params, terrain, before, commands)
        return jnp.mean(step_loss(jnp.asarray(self.deviation), before, predicted, after))


def open_loop(
    dynamics: Dynamics,
    params: Params,
    terrain: TerrainMap,
    window: Windows,
    read: Callable[[History], T],
) -> tuple[VehicleState, T]:
    """The K states predicted in one window, leaves `[K, 3]`, and what is read of the histories.

    The history is warmed up on the recorded context; from its last state on, the model sees its
    own predictions and the recorded commands. No gradient flows into the context.
    """
    c = window.context
    recorded, commands = VehicleState.from_vector(window.state), Command.from_vector(window.control)
    context, start = _at(recorded, slice(c + 1)), _at(recorded, c)
    history = warm_up(dynamics, params, terrain, context, _at(commands, slice(c)))

    def advance(
        carry: tuple[VehicleState, History], command: Command
    ) -> tuple[tuple[VehicleState, History], tuple[VehicleState, T]]:
        state, history = dynamics.step(params, terrain, carry[1], carry[0], command)
        return (state, history), (state, read(history))

    history = jax.lax.stop_gradient(history)
    return jax.lax.scan(advance, (start, history), _at(commands, slice(c, None)))[1]


def _at(tree: T, place: int | slice) -> T:
    return jax.tree.map(lambda x: x[place], tree)
