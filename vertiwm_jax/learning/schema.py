"""Recorded drives on disk: the format of a file, and what is checked when one is read.

A collection is a folder of `.npz` files, one a world, each with K drives of T steps at 10 Hz:

    state          [K, T + 1, 12]    p_world m, roll pitch yaw rad, v_body m/s, omega_body rad/s
    control        [K, T, 2]         commanded speed m/s, front-wheel angle rad, from t to t + 1
    length         [K]               valid steps of each drive
    meta           text              JSON with "map", the file name of the terrain map

and, as far as they were recorded (wheels in the order FL, FR, RL, RR),

    wheel_class    [K, T + 1, 4]     ground class under each wheel; without it, meta must have
                                     "vehicle": {"wheels_in_body_xy": [[x, y], ...]}, m
    wheel_omega    [K, T + 1, 4]     rad/s, positive forward
    wheel_sinkage  [K, T + 1, 4]     m below the undeformed ground; negative in the air
    wheel_force    [K, T + 1, 4, 3]  ground on wheel, world frame, N, mean over the last step
    chassis_force  [K, T + 1, 3]     ground on belly, the same
    steer_angle    [K, T + 1, 2]     front-left and front-right wheel, rad

Numbers may be of any precision. Arrays of other names are not read. Maps lie in a folder `maps`
inside the collection or beside it.
"""

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vertiwm_jax import atomic
from vertiwm_jax.errors import UserError
from vertiwm_jax.state import STEP_SECONDS

_REQUIRED = {
    "state": ("K", "T + 1", 12),
    "control": ("K", "T", 2),
    "length": ("K",),
}
WHEEL_SIGNALS = {
    "wheel_omega": ("K", "T + 1", 4),
    "wheel_sinkage": ("K", "T + 1", 4),
    "wheel_force": ("K", "T + 1", 4, 3),
    "chassis_force": ("K", "T + 1", 3),
    "steer_angle": ("K", "T + 1", 2),
}
"""Shapes of what may be recorded beside the states."""
_SHAPES = {**_REQUIRED, "wheel_class": ("K", "T + 1", 4), **WHEEL_SIGNALS}
_FLOATS = ("state", "control", *WHEEL_SIGNALS)

_LARGEST = {
    "wheel_omega": (1e3, "wheel speed in rad/s"),
    "wheel_sinkage": (10.0, "depth in m"),
    "wheel_force": (1e6, "force in N"),
    "chassis_force": (1e6, "force in N"),
    "steer_angle": (np.pi / 2, "wheel angle in rad"),
}
_LARGEST_SPEED = 50.0
_LARGEST_COORDINATE = 1e5
_MOVING = 1.0
"""Speed, m/s, above which the distance of a step is compared with it."""
_TRAVEL = (0.6, 1.6)
"""Bounds of that ratio: another sampling rate, km/h or centimetres lie beyond."""


class DataError(UserError, ValueError):
    """Recorded drives that cannot be used; the message names file, field and expectation."""


def read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays that a file has of the schema, in float32, and its meta.

    Raises `DataError` unless all of it can be used. Class ids need the map: see `check_classes`.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            missing = [name for name in (*_REQUIRED, "meta") if name not in archive]
            if missing:
                raise DataError(f"{path}: missing {', '.join(missing)}; found {archive.files}")
            arrays = {name: archive[name] for name in _SHAPES if name in archive}
            meta = str(archive["meta"])
    except DataError:
        raise
    except Exception as error:  # Zip, codecs and NumPy's header parser each have their own.
        raise DataError(f"{path}: expected an .npz archive of plain arrays: {error}") from error
    arrays = check(path, arrays)
    return arrays, _parse(path, meta, "wheel_class" in arrays)


def join(
    drives: Sequence[Mapping[str, np.ndarray]], steps: int | None = None
) -> dict[str, np.ndarray]:
    """K drives as arrays of the schema, each filled up with its last values.

    drives: by name, `[T + 1, ...]`, and "control" `[T, 2]`. steps: how long they become; by
    default as long as the longest.
    """
    length = np.array([len(drive["control"]) for drive in drives], np.int32)
    steps = int(length.max()) if steps is None else steps

    def filled(name: str, array: np.ndarray) -> np.ndarray:
        missing = steps + (name != "control") - len(array)
        array = array.astype(np.float32) if name in _FLOATS else array
        return np.pad(array, [(0, missing)] + [(0, 0)] * (array.ndim - 1), "edge")

    names = drives[0]
    found = {name: np.stack([filled(name, drive[name]) for drive in drives]) for name in names}
    return {**found, "length": length}


def write(
    path: Path, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any], wheels: ArrayLike
) -> None:
    """Writes a file, whole or not at all.

    meta: holds "map", the file name of the terrain map. wheels: `[4, 2]` x, y in the body, m.
    """
    vehicle = {"wheels_in_body_xy": np.asarray(wheels).tolist()}
    text = json.dumps({**meta, "dt": STEP_SECONDS, "vehicle": vehicle})
    stream = io.BytesIO()
    stored: dict[str, Any] = {**arrays, "meta": np.array(text)}
    np.savez_compressed(stream, **stored)
    atomic.write(path, stream.getvalue())


def check(path: Path, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays of the schema in float32; raises `DataError`, which names `path`, unless all fit."""
    _check_shapes(path, arrays)
    arrays = arrays | {name: arrays[name].astype(np.float32) for name in _FLOATS if name in arrays}
    _check_values(path, arrays)
    return arrays


def check_classes(path: Path, wheel_class: np.ndarray, classes: int) -> None:
    """Raises unless all are ids of the `classes` of the map."""
    integers = np.issubdtype(wheel_class.dtype, np.integer)
    if not integers or wheel_class.min() < 0 or wheel_class.max() >= classes:
        raise DataError(
            f"{path}: wheel_class: expected class ids 0 to {classes - 1} of its map, found "
            f"{wheel_class.dtype} from {wheel_class.min()} to {wheel_class.max()}"
        )


def find_map(path: Path, name: str) -> Path:
    """Where the map called `name` of a file of drives lies."""
    places = [path.parent / "maps" / name, path.parent.parent / "maps" / name]
    for place in places:
        if place.is_file():
            return place
    raise DataError(f"{path}: meta: its map {name} was expected at {places[0]} or {places[1]}")


def _parse(path: Path, text: str, classes_known: bool) -> dict[str, Any]:
    try:
        meta = json.loads(text)
        map_name = meta["map"]
    except (json.JSONDecodeError, KeyError, TypeError):
        map_name = None
    if not isinstance(map_name, str):
        raise DataError(
            f'{path}: meta: expected JSON with "map", the file name of the terrain map; '
            f"found {text[:80]}"
        )
    if not classes_known:
        try:
            wheels = np.asarray(meta["vehicle"]["wheels_in_body_xy"], float)
        except (KeyError, TypeError, ValueError):
            wheels = np.zeros(0)
        if wheels.shape != (4, 2) or not np.isfinite(wheels).all():
            raise DataError(
                f"{path}: missing wheel_class, and meta: expected vehicle.wheels_in_body_xy, "
                f"four x, y in m, to look the classes up on the map; found {text[:80]}"
            )
    return meta


def _check_shapes(path: Path, arrays: dict[str, np.ndarray]) -> None:
    control = arrays["control"].shape
    if len(control) != 3:
        raise DataError(f"{path}: control: expected shape [K, T, 2], found {list(control)}")
    sizes = {"K": control[0], "T": control[1], "T + 1": control[1] + 1}
    for name, array in arrays.items():
        shape = _SHAPES[name]
        wanted = tuple(size if isinstance(size, int) else sizes[size] for size in shape)
        if array.shape != wanted:
            raise DataError(
                f"{path}: {name}: expected shape {list(wanted)} (K and T as in control), "
                f"found {list(array.shape)}"
            )
    if not (control[0] and control[1]):
        raise DataError(
            f"{path}: control: expected one drive or more, of one step or more, "
            f"found shape {list(control)}"
        )
    for name in _FLOATS:
        if name in arrays and arrays[name].dtype.kind not in "fiu":
            raise DataError(f"{path}: {name}: expected numbers, found dtype {arrays[name].dtype}")


def _check_values(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Finite where valid, and in SI units: degrees, millimetres and km/h are told apart."""
    length, steps = arrays["length"], arrays["control"].shape[1]
    if not np.issubdtype(length.dtype, np.integer) or length.min() < 0 or length.max() > steps:
        raise DataError(f"{path}: length: expected integers in 0 to {steps}, found {length}")
    valid = np.arange(steps + 1) <= length[:, None]
    state, control = arrays["state"][valid], arrays["control"][valid[:, 1:]]
    limits = [
        ("state", state[:, 0:3], _LARGEST_COORDINATE, "position in m"),
        ("state", state[:, 3:6], 2 * np.pi, "roll, pitch and yaw in rad"),
        ("state", state[:, 6:9], _LARGEST_SPEED, "velocity in m/s"),
        ("state", state[:, 9:12], 10 * np.pi, "angular velocity in rad/s"),
        ("control", control[:, 0], _LARGEST_SPEED, "commanded speed in m/s"),
        ("control", control[:, 1], np.pi / 2, "front-wheel angle in rad"),
    ]
    limits += [
        (name, arrays[name][valid], *_LARGEST[name]) for name in WHEEL_SIGNALS if name in arrays
    ]
    for name, values, limit, meaning in limits:
        bad = ~(np.abs(values) <= limit)
        if bad.any():
            raise DataError(
                f"{path}: {name}: expected finite {meaning} within {limit:.4g}, "
                f"found {values[bad][0]:.4g} among {bad.sum()} such values"
            )
    _check_travel(path, arrays["state"], valid)


def _check_travel(path: Path, state: np.ndarray, valid: np.ndarray) -> None:
    speed = np.linalg.norm(state[:, :-1, 6:9], axis=-1)
    moving = valid[:, 1:] & (speed > _MOVING)
    if not moving.any():
        return
    travel = np.linalg.norm(np.diff(state[..., :3], axis=1), axis=-1)[moving]
    ratio = np.median(travel / (speed[moving] * STEP_SECONDS))
    if not _TRAVEL[0] < ratio < _TRAVEL[1]:
        raise DataError(
            f"{path}: state: expected positions in m that move with the velocity in m/s, one step "
            f"in {STEP_SECONDS:g} s; found steps {ratio:.3g} times as long"
        )
