"""The loop that moves a vehicle in a simulator outside jit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vertiwm_jax.simulators.protocol import Observation, Simulator

Ending = Literal["time", "left the map", "rolled over", "diverged"]

Pilot = Callable[[np.ndarray], np.ndarray | None]
"""State `[12]` to the command `[2]` of the next step: speed, m/s, and front-wheel angle, rad.

None ends the drive.
"""


@dataclass(frozen=True)
class Drive:
    """One drive of T steps.

    observations: T + 1; control: `[T, 2]` commanded speed, m/s, and front-wheel angle, rad.
    """

    observations: list[Observation]
    control: np.ndarray
    ending: Ending


def drive(
    simulator: Simulator,
    start: Sequence[float],
    pilot: Pilot,
    steps: int,
    over: Callable[[np.ndarray], Ending | None] = lambda state: None,
) -> Drive:
    """Drives until `steps` are done, the pilot gives no command, or it is over.

    Args:
        simulator: what moves the vehicle.
        start: x, y, m, and yaw, rad.
        pilot: what commands it.
        steps: of 0.1 s, at most.
        over: tells of a state `[12]` why the drive cannot go on, if it cannot.

    Returns:
        The drive; a state that diverged is left out.
    """
    observations, control = [simulator.start(*start)], []
    state = np.asarray(observations[0].state)
    ending = over(state)
    while ending is None and len(control) < steps:
        command = pilot(state)
        if command is None:
            break
        seen = simulator.step(command)
        state = np.asarray(seen.state)
        ending = over(state)
        if ending != "diverged":
            control.append(command)
            observations.append(seen)
    return Drive(observations, np.reshape(control, (-1, 2)), ending or "time")
