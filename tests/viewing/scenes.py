"""A small scene with everything in it."""

from dataclasses import replace

import numpy as np
from env.worlds import SNOW, hills

from vertiwm_jax.learning.dataset import WheelSignals
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.viewing.scene import Prediction, Scene

STEPS = 20


def scene() -> Scene:
    """2 s over hills in a bend, two predictions of 6 steps from 4 and 10 on, and a goal."""
    rng = np.random.default_rng(0)
    boxes = np.array([[18, 4, 2, 3, 1], [0, 0, 0, 0, 0]], np.float32)
    terrain = TerrainMap.from_array(hills(65), np.full((8, 8), SNOW), obstacles=boxes)
    time = 0.1 * np.arange(STEPS + 1)
    state = rng.normal(0, 0.1, (STEPS + 1, 12)).astype(np.float32)
    state[:, 0], state[:, 1], state[:, 2], state[:, 5] = 9 * time, time**2, 2.5, time
    start = np.array([4, 10])
    parts = np.stack([state[i : i + 7] for i in start]) + np.float32(0.1)
    parts[:, 0] -= np.float32(0.1)
    return Scene(
        title="a bend",
        terrain=terrain,
        state=state,
        command=np.stack([3 + time[:-1], 0.1 * time[:-1]], axis=1),
        wheels=WheelSignals(
            wheel_omega=np.full((STEPS + 1, 4), 5.0),
            wheel_sinkage=rng.uniform(-0.1, 0.1, (STEPS + 1, 4)),
        ),
        goal=np.array([25.0, 5.0, 2.0]),
        goal_radius=4.0,
        prediction=Prediction(
            start, parts, rng.uniform(0, 1, (2, 6, 4)), rng.uniform(0, 0.1, (2, 6, 4))
        ),
    )


def bare() -> Scene:
    """The same drive, and nothing but the drive."""
    return replace(scene(), wheels=None, goal=None, prediction=None)
