"""Reads TartanDrive: trajectories of version 1 and folders of version 2. Bags are ROS 1 bags.

A trajectory of version 1 is what its authors' `multi_convert_bag.py` writes by `torch.save`: a
dictionary of `observation`, a dictionary with the state `[T, 7]` or `[T, 13]`; `action`, `[T, 2]`;
and `dt`, `[T]` s. Version 2 has a folder for each topic, with one row a message in
`interp_data.txt`, states `[N, 13]` or commands `[N, 2]`, and their stamps in
`interp_timestamps.txt`, s. States are x, y, z, quaternion x, y, z, w and, where there are 13, the
twist of the odometry; commands are throttle and steering.

What `numpy.savez` wrote of such a dictionary holds pickled objects, and is not read.
"""

import pickle
from pathlib import Path

import numpy as np

from vertiwm_jax.importers import log
from vertiwm_jax.importers.log import Log
from vertiwm_jax.importers.settings import ImportSettings
from vertiwm_jax.learning.schema import DataError

_STATE = (7, 13)
_UNREADABLE = (OSError, RuntimeError, EOFError, ValueError, pickle.UnpicklingError)
"""Errors of torch and pickle for a file that is no trajectory."""


def read(path: Path, settings: ImportSettings) -> list[Log]:
    """Reads the log of a `.pt` trajectory or of a folder; raises `DataError`."""
    load = _folder if path.is_dir() else _trajectory
    time, state, command_time, command = load(path, settings)
    moving = state.shape[1] == _STATE[1]
    return [
        log.build(
            path,
            settings,
            time=time,
            position=state[:, :3],
            attitude=state[:, 3:7],
            velocity=state[:, 7:10] if moving else None,
            angular_velocity=state[:, 10:13] if moving else None,
            command_time=command_time,
            command=command,
        )
    ]


def _folder(path: Path, settings: ImportSettings) -> tuple[np.ndarray, ...]:
    names = settings.tartandrive
    state_time, state = _topic(path / names.state, _STATE)
    command_time, command = _topic(path / names.command, (2,))
    return state_time, state, command_time, command


def _topic(folder: Path, widths: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """`[N]` stamps and `[N, width]` values."""
    try:
        stamps = np.loadtxt(folder / "interp_timestamps.txt", ndmin=1)
        values = np.loadtxt(folder / "interp_data.txt", ndmin=2)
    except ValueError as error:
        raise DataError(f"{folder}: expected text files of numbers: {error}") from None
    _check_shape(f"{folder}/interp_data.txt", values, len(stamps), widths)
    return stamps, values


def _trajectory(path: Path, settings: ImportSettings) -> tuple[np.ndarray, ...]:
    if path.suffix != ".pt":
        raise DataError(
            f"{path}: expected a .pt trajectory (version 1 of TartanDrive) or a folder (version 2)"
        )
    try:
        import torch  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise DataError(
            f"{path}: expected the package torch to read it, it is not installed; pip install torch"
        ) from None
    try:
        # Only tensors in plain containers: a pickle of anything else could run any code.
        trajectory = torch.load(path, map_location="cpu", weights_only=True)
        state = trajectory["observation"][settings.tartandrive.state].double().numpy()
        command = trajectory["action"].double().numpy()
        dt = trajectory["dt"].double().numpy()
    except (*_UNREADABLE, LookupError, AttributeError, TypeError) as error:
        raise DataError(
            f"{path}: expected a dictionary of observation.{settings.tartandrive.state}, action "
            f"and dt: {' '.join(str(error).split())}"
        ) from None
    _check_shape(f"{path}: observation.{settings.tartandrive.state}", state, len(dt), _STATE)
    _check_shape(f"{path}: action", command, len(dt), (2,))
    stamps = np.cumsum(dt) - dt[:1]
    return stamps, state, stamps, command


def _check_shape(name: str, array: np.ndarray, rows: int, widths: tuple[int, ...]) -> None:
    if array.ndim != 2 or array.shape[0] != rows or array.shape[1] not in widths:
        wanted = " or ".join(f"[{rows}, {width}]" for width in widths)
        raise DataError(f"{name}: expected shape {wanted}, found {list(array.shape)}")
