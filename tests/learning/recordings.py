"""Synthetic recorded drives: straight, at constant speeds, over level grass."""

import json
from pathlib import Path

import numpy as np

from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import TerrainMap

STEPS, GRASS, SNOW = 40, 3, 9


def drives(count: int = 25, steps: int = STEPS) -> dict[str, np.ndarray]:
    """The arrays of a good file: straight drives; the speed tells the drive."""
    time = 0.1 * np.arange(steps + 1)
    state = np.zeros((count, steps + 1, 12), np.float32)
    state[:, :, 6] = 1 + 0.1 * np.arange(count)[:, None]
    state[:, :, 0] = state[:, :, 6] * time
    control = np.zeros((count, steps, 2), np.float32)
    control[:, :, 0] = state[:, :-1, 6]
    return {
        "state": state,
        "control": control,
        "length": np.full(count, steps, np.int32),
        "wheel_class": np.full((count, steps + 1, 4), GRASS, np.uint8),
        "meta": np.array(json.dumps({"map": "hill.npz"})),
    }


def write(folder: Path, name: str = "a.npz", **changes: np.ndarray | None) -> Path:
    """A good file with some arrays replaced, or left out, and its map."""
    arrays = {**drives(), **changes}
    (folder / "maps").mkdir(exist_ok=True)
    hill = TerrainMap.from_array(np.ones((9, 9)), np.full((4, 4), GRASS))
    files.save(hill, folder / "maps" / "hill.npz")
    np.savez(folder / name, **{k: v for k, v in arrays.items() if v is not None})
    return folder / name


def wheel_signals(count: int = 25, steps: int = STEPS) -> dict[str, np.ndarray]:
    """All that may be recorded beside the states: random, of the usual magnitudes."""
    rng = np.random.default_rng(0)
    magnitudes = {
        "wheel_omega": ((4,), 6.0),
        "wheel_sinkage": ((4,), 0.05),
        "wheel_force": ((4, 3), 6000.0),
        "chassis_force": ((3,), 9000.0),
        "steer_angle": ((2,), 0.2),
    }
    return {
        name: rng.normal(0, scale, (count, steps + 1, *shape)).astype(np.float32)
        for name, (shape, scale) in magnitudes.items()
    }
