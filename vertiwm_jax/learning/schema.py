"""Recorded drives on disk: the format of a file, and what is checked when one is read.

A collection is a folder of `.npz` files, one a world, each with K drives of T steps at 10 Hz:

    state          [K, T + 1, 12]    p_world m, roll pitch yaw rad, v_body m/s, omega_body rad/s
    control        [K, T, 2]         commanded speed m/s and turn, from t to t + 1: a front-wheel
                                     angle rad, or the yaw rate rad/s where meta has
                                     "vehicle": {"turn": "yaw_rate"}, of a skid-steered vehicle
    length         [K]               valid steps of each drive
    meta           text              JSON with "map", the file name of the terrain map; may have
                                     "vehicle": {"name": ...}, and describe the vehicle there
                                     (`mechanics.measured`)

and, as far as they were recorded (wheels in the order FL, FR, RL, RR),

    wheel_class    [K, T + 1, 4]     ground class under each wheel; without it, meta must have
                                     "vehicle": {"wheels_in_body_xy": [[x, y], ...]}, m
    wheel_omega    [K, T + 1, 4]     rad/s, positive forward
    wheel_sinkage  [K, T + 1, 4]     m below the undeformed ground; negative in the air
    wheel_force    [K, T + 1, 4, 3]  ground on wheel, world frame, N, mean over the last step
    chassis_force  [K, T + 1, 3]     ground on belly, the same
    steer_angle    [K, T + 1, 2]     front-left and front-right wheel, rad
    split          [K]               what each drive is for: "train", "validation" or "test";
                                     without it, drives are shared out (`dataset.SplitConfig`)

Files of 25 drives whose meta has "steering_amplitude" are those of Chrono that the shipped models
learned from. They are older than `split` and say it so: 20 drives to train, 2 to validate, 3 to
test, in this order.

Numbers may be of any precision. Arrays of other names are not read. Maps lie in a folder `maps`
inside the collection or beside it. Positions are in the coordinates of the map's file: where these
are large, as those of UTM are, in float64.
"""

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from vertiwm_jax import atomic
from vertiwm_jax.arrays import load_archive
from vertiwm_jax.errors import UserError, refusing
from vertiwm_jax.state import STEP_SECONDS, Turn

SPLITS = "train", "validation", "test"
"""What drives are for."""
WHEEL_SIGNALS = {
    "wheel_omega": (4,),
    "wheel_sinkage": (4,),
    "wheel_force": (4, 3),
    "chassis_force": (3,),
    "steer_angle": (2,),
}
"""What may be recorded beside the states, and its shape at one moment."""
UNNAMED = "unnamed"
"""A vehicle whose name no file says."""
_REQUIRED = {"state": (12,), "control": (2,), "length": ()}
_SHAPES = {**_REQUIRED, "wheel_class": (4,), **WHEEL_SIGNALS, "split": ()}
_EARLIER = np.repeat(SPLITS, (20, 2, 3))
"""What the drives of files are for that are older than `split`."""
_ALL = slice(None)
_LIMITS = (
    ("state", slice(0, 3), 1e5, "position in m"),
    ("state", slice(3, 6), 2 * np.pi, "roll, pitch and yaw in rad"),
    ("state", slice(6, 9), 50.0, "velocity in m/s"),
    ("state", slice(9, 12), 10 * np.pi, "angular velocity in rad/s"),
    ("control", 0, 50.0, "commanded speed in m/s"),
    ("wheel_omega", _ALL, 3e3, "wheel speed in rad/s"),
    ("wheel_sinkage", _ALL, 10.0, "depth in m"),
    ("wheel_force", _ALL, 1e6, "force in N"),
    ("chassis_force", _ALL, 1e6, "force in N"),
    ("steer_angle", _ALL, np.pi / 2, "wheel angle in rad"),
)
_TURN_LIMITS: dict[Turn, tuple[str, int, float, str]] = {
    "steering": ("control", 1, np.pi / 2, "front-wheel angle in rad"),
    "yaw_rate": ("control", 1, 10 * np.pi, "commanded yaw rate in rad/s"),
}
"""Array, columns, largest absolute value and meaning: degrees, millimeters and km/h lie beyond."""
_FLOATS = tuple(dict.fromkeys(name for name, *_ in _LIMITS))
_MOVING = 1.0
"""Speed, m/s, above which the distance of a step is compared with it."""
_BASE = 5
"""Steps over which that distance is measured: noise of positions counts less over more."""
_TRAVEL = (0.6, 1.6)
"""Bounds of that ratio: another sampling rate, km/h or centimeters lie beyond."""


class DataError(UserError, ValueError):
    """Recorded drives that cannot be used; the message names file, field and expectation."""


def read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays of a file that the schema names, as they are stored, and its meta.

    Raises `DataError` unless they are there. What they hold needs the map: see `check` and
    `check_classes`.
    """
    found = _stored(path, (*_SHAPES, "meta"), (*_REQUIRED, "meta"))
    meta = str(found.pop("meta"))
    return found, _parse(path, meta, "wheel_class" in found)


def outline(path: Path) -> tuple[np.ndarray, np.ndarray | None, str]:
    """Of the drives of a file: `[K]` lengths, `[K]` what each is for if the file says it, its map.

    For what is to be known before drives are read. Raises `DataError`.
    """
    found = _stored(path, ("length", "split", "meta"), ("length", "meta"))
    length, meta = found["length"], _parse(path, str(found["meta"]), classes_known=True)
    whole = length.dtype.kind in "iu" and length.ndim == 1
    if not (whole and len(length) and length.min() >= 0):
        check(path, read(path)[0], np.zeros(2))  # Says what is wrong.
    split = found.get("split")
    if split is not None:
        unknown = [str(found) for found in split.flat if found not in SPLITS]
        if split.shape != length.shape or unknown:
            raise DataError(
                f"{path}: split: expected one of {', '.join(SPLITS)} for each of {len(length)} "
                f"drives, found {unknown[0] if unknown else list(split.shape)}"
            )
    elif len(length) == len(_EARLIER) and "steering_amplitude" in meta:
        split = _EARLIER
    return length, split, meta["map"]


def _stored(path: Path, names: Sequence[str], required: Sequence[str]) -> dict[str, np.ndarray]:
    """The arrays of these names, as far as the file has them."""
    expected = f"{path}: expected an .npz archive of plain arrays"
    refused = refusing(lambda found: DataError(f"{expected}: {found}"))
    with refused:
        found = load_archive(path, names)
    missing = [name for name in required if name not in found]
    if missing:
        raise DataError(f"{path}: missing {', '.join(missing)}; found {list(found)}")
    return found


def vehicle_facts(meta: Mapping[str, Any]) -> dict[str, Any]:
    """What the meta of a file says of its vehicle; see `mechanics.measured`."""
    vehicle = meta.get("vehicle")
    return vehicle if isinstance(vehicle, dict) else {}


def turn_of(path: Path, facts: Mapping[str, Any]) -> Turn:
    """What the second of the commands of a file is, by what it says of its vehicle."""
    turn = facts.get("turn", "steering")
    for known in get_args(Turn):
        if turn == known:
            return known
    known = " or ".join(get_args(Turn))
    raise DataError(f"{path}: meta: expected vehicle.turn {known}, found {turn!r}")


def vehicle_name(facts: Mapping[str, Any]) -> str:
    """What a file calls its vehicle by name or model; or else `UNNAMED`."""
    return str(facts.get("name") or facts.get("model") or UNNAMED)


def drive(state: np.ndarray, control: np.ndarray, **others: np.ndarray) -> dict[str, np.ndarray]:
    """One drive as arrays of the schema, K = 1.

    state: `[T + 1, 12]`; control: `[T, 2]`; others: by name, `[T + 1, ...]`.
    """
    arrays = {"state": state, "control": control, **others}
    kinds = {name: np.float32 for name in _FLOATS}
    found = {name: x[None].astype(kinds.get(name, x.dtype)) for name, x in arrays.items()}
    return {**found, "length": np.array([len(control)], np.int32)}


def join(parts: Sequence[Mapping[str, np.ndarray]], steps: int = 0) -> dict[str, np.ndarray]:
    """The drives of all parts one after the other, each filled up with its last values.

    parts: arrays of the schema, of the same names, and others `[K]`. steps: how long drives become
    at least; they become as long as the longest.
    """
    steps = max(steps, *(part["control"].shape[1] for part in parts))

    def filled(name: str, array: np.ndarray) -> np.ndarray:
        if array.ndim == 1:
            return array
        missing = steps + (name != "control") - array.shape[1]
        return np.pad(array, [(0, 0), (0, missing)] + [(0, 0)] * (array.ndim - 2), "edge")

    return {name: np.concatenate([filled(name, part[name]) for part in parts]) for name in parts[0]}


def in_file(arrays: Mapping[str, np.ndarray], offset: np.ndarray) -> Mapping[str, np.ndarray]:
    """The same with positions as in the file of the map; offset: `TerrainMap.offset` of it."""
    if not offset.any():
        return arrays
    return {**arrays, "state": arrays["state"] + np.pad(offset, (0, 10))}


def write(
    path: Path,
    arrays: Mapping[str, np.ndarray],
    meta: Mapping[str, Any],
    wheels: ArrayLike,
    turn: Turn = "steering",
) -> None:
    """Writes a file, whole or not at all.

    arrays: with positions as in the file of the map, see `in_file`. meta: holds "map", the name of
    that file. wheels: `[4, 2]` x, y in the body, m. turn: what the second of the commands is.
    """
    vehicle = {"wheels_in_body_xy": np.asarray(wheels).tolist(), "turn": turn}
    text = json.dumps({**meta, "dt": STEP_SECONDS, "vehicle": vehicle})
    stream = io.BytesIO()
    stored: dict[str, Any] = {**arrays, "meta": np.array(text)}
    np.savez_compressed(stream, **stored)
    atomic.write(path, stream.getvalue())


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


def check(
    path: Path,
    arrays: dict[str, np.ndarray],
    offset: np.ndarray = np.zeros(2),
    turn: Turn = "steering",
) -> dict[str, np.ndarray]:
    """Arrays of the schema, numbers in float32; raises `DataError`, which names `path`.

    They have to be of the right shape, finite where they are valid, and in SI units. offset:
    `TerrainMap.offset` of their map, which is taken off the positions. turn: see `turn_of`.
    """
    arrays = check_values(path, arrays, offset, turn)
    check_travel(path, arrays)
    return arrays


def check_values(
    path: str | Path,
    arrays: dict[str, np.ndarray],
    offset: np.ndarray = np.zeros(2),
    turn: Turn = "steering",
) -> dict[str, np.ndarray]:
    """As `check`, but whether positions move with the velocities is left aside."""
    if arrays["control"].ndim != 3:
        found = list(arrays["control"].shape)
        raise DataError(f"{path}: control: expected shape [K, T, 2], found {found}")
    drives, steps, _ = arrays["control"].shape
    for name, array in arrays.items():
        axes = {"length": (), "split": (), "control": (steps,)}.get(name, (steps + 1,))
        wanted = (drives, *axes, *_SHAPES[name])
        if array.shape != wanted:
            raise DataError(
                f"{path}: {name}: expected shape {list(wanted)} (K and T as in control), "
                f"found {list(array.shape)}"
            )
        if name in _FLOATS and array.dtype.kind not in "fiu":
            raise DataError(f"{path}: {name}: expected numbers, found dtype {array.dtype}")
    if not (drives and steps):
        raise DataError(
            f"{path}: control: expected one drive or more, of one step or more, "
            f"found shape {[drives, steps, 2]}"
        )
    length = arrays["length"]
    if not np.issubdtype(length.dtype, np.integer) or length.min() < 0 or length.max() > steps:
        raise DataError(f"{path}: length: expected integers in 0 to {steps}, found {length}")
    if offset.any():
        if arrays["state"].dtype.kind == "f" and arrays["state"].dtype.itemsize < 8:
            x, y = offset
            raise DataError(
                f"{path}: state: expected float64, because positions on its map are about "
                f"({x:.10g}, {y:.10g}) m, found {arrays['state'].dtype}"
            )
        arrays = arrays | {"state": arrays["state"] - np.pad(offset, (0, 10))}
    arrays = arrays | {name: arrays[name].astype(np.float32) for name in _FLOATS if name in arrays}
    valid = np.arange(steps + 1) <= length[:, None]
    for name, columns, limit, meaning in (*_LIMITS, _TURN_LIMITS[turn]):
        if name in arrays:
            values = arrays[name][valid[:, 1:] if name == "control" else valid][..., columns]
            bad = ~(np.abs(values) <= limit)
            if bad.any():
                raise DataError(
                    f"{path}: {name}: expected finite {meaning} within {limit:.4g}, "
                    f"found {values[bad][0]:.4g} among {bad.sum()} such values"
                )
    return arrays


def check_travel(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Raises `DataError` unless the positions of most drives move as fast as their velocities."""
    state = arrays["state"]
    base = min(_BASE, state.shape[1] - 1)
    speed = np.linalg.norm(state[:, :-1, 6:9], axis=-1)
    speed = np.lib.stride_tricks.sliding_window_view(speed, base, axis=1).mean(axis=-1)
    valid = np.arange(base, state.shape[1]) <= arrays["length"][:, None]
    moving = valid & (speed > _MOVING)
    travel = np.linalg.norm(state[:, base:, :3] - state[:, :-base, :3], axis=-1)[moving]
    seconds = base * STEP_SECONDS
    ratio = np.median(travel / (speed[moving] * seconds)) if moving.any() else 1.0
    if not _TRAVEL[0] < ratio < _TRAVEL[1]:
        raise DataError(
            f"{path}: state: expected positions in m that move with the velocity in m/s, one step "
            f"in {STEP_SECONDS:g} s; found steps {ratio:.3g} times as long"
        )


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
