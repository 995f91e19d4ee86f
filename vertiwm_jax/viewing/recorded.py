"""Recorded drives as scenes, with what a model predicts of them."""

from pathlib import Path

import jax
import numpy as np

from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.evaluation import prediction
from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.dataset import Drives
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.viewing.scene import Prediction, Scene

STEPS = 16
"""Of a prediction, and of the recorded drive that the model sees before it, as in the tables."""


def load(path: Path, drive: int, name: str, dynamics: Dynamics, params: Params) -> Scene:
    """Loads a recorded drive, and predicts it every 16 steps.

    Args:
        path: a file of drives.
        drive: number of the drive in the file.
        name: what the model is called, for the title.
        dynamics, params: the model.

    Raises:
        DataError, MapError: the file cannot be used, or has no such drive of 32 steps or more.
    """
    drives, terrain = dataset.load_file(path)
    count = len(drives.length)
    if not 0 <= drive < count:
        raise DataError(f"{path}: drive: expected 0 to {count - 1}, found {drive}")
    length = int(drives.length[drive])
    if length < 2 * STEPS:
        raise DataError(
            f"{path}: drive {drive}: expected at least {2 * STEPS} steps, found {length}"
        )
    alone: Drives = jax.tree.map(lambda x: np.asarray(x)[drive : drive + 1], drives)
    test = TestWindows.of(alone, terrain, STEPS, STEPS, STEPS)
    states, read = prediction.predict(dynamics, params, test)
    first = np.asarray(test.windows.state)[:, STEPS]
    return Scene(
        title=f"{path.stem}, drive {drive}, and {name}",
        terrain=terrain,
        state=np.asarray(alone.state)[0, : length + 1],
        command=np.asarray(alone.control)[0, :length],
        wheels=jax.tree.map(lambda x: x[0, : length + 1], alone.wheels),
        prediction=Prediction(
            start=STEPS * (1 + np.arange(len(test))),
            state=np.concatenate([first[:, None], states.vector], axis=1),
            coefficients=read.coefficients,
            sinkage=read.wheels and np.asarray(read.wheels.wheel_sinkage),
        ),
    )
