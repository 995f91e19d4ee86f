"""The data of a drive that recordings and movies show."""

from dataclasses import dataclass, field

import numpy as np

from vertiwm_jax.learning.dataset import WheelSignals
from vertiwm_jax.mechanics.vehicle import Vehicle, load_vehicle
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model.fusion import COEFFICIENTS

WHEELS = ("front left", "front right", "rear left", "rear right")
TILT, FUSION = "roll and pitch [deg]", "fusion: 0 Transformer, 1 NeSAM"
"""Titles of two panels."""
Panels = dict[str, dict[str, np.ndarray]]


@dataclass(frozen=True)
class Prediction:
    """Open-loop predictions of H steps from N states of a drive.

    start: `[N]` steps of the drive at which predictions start.
    state: `[N, H + 1, 12]`; the first of each is recorded.
    coefficients: `[N, H, 4]` fusion coefficients; None if the model does not fuse.
    sinkage: `[N, H, 4]` of the wheels, m; None if the model has no wheels.
    """

    start: np.ndarray
    state: np.ndarray
    coefficients: np.ndarray | None = None
    sinkage: np.ndarray | None = None

    def along(self, values: np.ndarray, steps: int) -> np.ndarray:
        """Values `[N, H, ...]` of predicted steps as `[steps + 1, ...]` of the drive, else NaN."""
        found = np.full((steps + 1, *values.shape[2:]), np.nan, np.float32)
        for start, part in zip(self.start, values, strict=True):
            found[start + 1 : start + 1 + len(part)] = part
        return found


@dataclass(frozen=True)
class Scene:
    """A drive of T steps of 0.1 s on the selected world of a map.

    title: in a few words.
    state: `[T + 1, 12]`; command: `[T, 2]` m/s and rad.
    wheels: leaves `[T + 1, ...]`, where known; None if the model has no wheels.
    coefficients: `[T + 1, 4]` fusion coefficients of the step to each state; None if the model
        does not fuse.
    goal: `[3]` m, reached within `goal_radius` m; None if the drive has no goal.
    prediction: open-loop predictions of a model, if any.
    """

    title: str
    terrain: TerrainMap
    state: np.ndarray
    command: np.ndarray
    wheels: WheelSignals | None = None
    coefficients: np.ndarray | None = None
    goal: np.ndarray | None = None
    goal_radius: float = 0.0
    prediction: Prediction | None = None
    vehicle: Vehicle = field(default_factory=load_vehicle)

    @property
    def steps(self) -> int:
        """T, the number of steps."""
        return len(self.command)

    @property
    def world(self) -> int:
        """Index of the selected world."""
        return int(self.terrain.world)

    @property
    def seconds(self) -> np.ndarray:
        """`[T + 1]` time of the states, s."""
        return STEP_SECONDS * np.arange(self.steps + 1)

    @property
    def commanded(self) -> np.ndarray:
        """`[T + 1, 2]` the command at each state; the last command is repeated."""
        return self.command[np.minimum(np.arange(self.steps + 1), self.steps - 1)]

    @property
    def steering(self) -> np.ndarray:
        """`[T + 1, 4]` angle of each wheel, rad, left positive; as commanded where unknown."""
        if self.vehicle.skid is not None:
            return np.zeros((self.steps + 1, 4))
        front = self.wheels and self.wheels.steer_angle
        if front is None:
            front = np.repeat(self.commanded[:, 1:], 2, axis=1)
        return np.concatenate([front, np.zeros_like(front)], axis=1)

    @property
    def turned(self) -> np.ndarray:
        """`[T + 1, 4]` rotation of each wheel, rad, forward positive; 0 if unknown."""
        speed = self.wheels and self.wheels.wheel_omega
        if speed is None:
            return np.zeros((self.steps + 1, 4))
        return np.cumsum(speed, axis=0) * STEP_SECONDS


def panels(scene: Scene) -> Panels:
    """Time series to plot, `[T + 1]` by panel title and name; NaN where a value is unknown."""
    roll, pitch = np.degrees(scene.state[:, 3:5]).T
    shown: Panels = {
        TILT: {"roll": roll, "pitch": pitch},
        "speed [m/s]": {"driven": scene.state[:, 6], "commanded": scene.commanded[:, 0]},
    }
    alpha, prediction = scene.coefficients, scene.prediction
    depth = scene.wheels and scene.wheels.wheel_sinkage
    if depth is not None:
        shown["wheel sinkage [mm]"] = _sinkage(np.asarray(depth))
    if prediction:
        states = prediction.along(prediction.state[:, 1:], scene.steps)
        for name, row in (("roll", 3), ("pitch", 4)):
            shown[TILT][f"{name}, predicted"] = np.degrees(states[:, row])
        shown["speed [m/s]"]["predicted"] = states[:, 6]
        error = np.linalg.norm(states[:, :3] - scene.state[:, :3], axis=1)
        shown["position error [m]"] = {"position error": error}
        if prediction.sinkage is not None:
            depth = prediction.along(prediction.sinkage, scene.steps)
            shown["wheel sinkage, predicted [mm]"] = _sinkage(depth)
        if prediction.coefficients is not None:
            alpha = prediction.along(prediction.coefficients, scene.steps)
    if alpha is not None:
        shown[FUSION] = dict(zip(COEFFICIENTS, alpha.T, strict=True))
    return shown


def _sinkage(depth: np.ndarray) -> dict[str, np.ndarray]:
    # Recorded sinkage of a wheel in the air is negative, predicted sinkage is 0.
    return dict(zip(WHEELS, 1000 * np.maximum(depth, 0.0).T, strict=True))
