import json

import numpy as np
import pytest
from learning.recordings import STEPS, drives, wheel_signals, write

from vertiwm_jax.learning import dataset, schema
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.mechanics import vehicle


def broken(name: str, place: tuple, value: float) -> np.ndarray:
    array = drives()[name]
    array[place] = value
    return array


def stretched(factor: float) -> np.ndarray:
    """States whose positions are `factor` times as far apart."""
    return drives()["state"] * np.where(np.arange(12) < 3, factor, 1)


def spoilt(name: str, value: float) -> np.ndarray:
    array = wheel_signals()[name]
    array[3, 7, 0] = value
    return array


DEFECTS = {
    "missing array": ({"state": None}, "missing state"),
    "missing meta": ({"meta": None}, "missing meta"),
    "rank of control": ({"control": np.zeros((25, STEPS))}, r"control: expected shape \[K, T, 2\]"),
    "shape of state": ({"state": np.zeros((25, STEPS, 12))}, r"state: expected shape \[25, 41, 12"),
    "shape of length": ({"length": np.zeros(24, int)}, r"length: expected shape \[25\]"),
    "shape of classes": ({"wheel_class": np.zeros((25, 41, 2))}, r"wheel_class: expected shape"),
    "too long": ({"length": np.full(25, STEPS + 1)}, "length: expected integers in 0 to 40"),
    "negative length": ({"length": np.full(25, -1)}, "length: expected integers"),
    "length in seconds": ({"length": np.full(25, 4.0)}, "length: expected integers"),
    "NaN in a state": ({"state": broken("state", (3, 7, 2), np.nan)}, "state: .*position"),
    "inf in a control": ({"control": broken("control", (1, 0, 0), np.inf)}, "control: .*speed"),
    "heading in degrees": ({"state": broken("state", (0, 5, 5), 90.0)}, "state: .*rad"),
    "steering in degrees": ({"control": broken("control", (0, 5, 1), 15.0)}, "control: .*rad"),
    "speed in km/h": ({"state": broken("state", (0, 5, 6), 60.0)}, "state: .*m/s"),
    "rate in degrees": ({"state": broken("state", (0, 5, 11), 45.0)}, "state: .*rad/s"),
    "position in mm": ({"state": broken("state", (0, 5, 0), 5e5)}, "state: .*position in m"),
    "unknown class": (
        {"wheel_class": np.full((25, STEPS + 1, 4), 200, np.uint8)},
        "wheel_class: expected class ids 0 to 9",
    ),
    "class not a number": (
        {"wheel_class": np.full((25, STEPS + 1, 4), 0.5)},
        "wheel_class: expected",
    ),
    "states not numbers": ({"state": np.full((25, STEPS + 1, 12), "1.0")}, "state: expected numb"),
    "no drives": (
        {name: array[:0] for name, array in drives().items() if name != "meta"},
        "control: expected one drive or more",
    ),
    "other sampling rate": (
        {"state": drives()["state"] * np.where(np.arange(12) < 3, 2.0, 1.0)},
        "state: .*found steps 2 times as long",
    ),
    "positions in cm": (
        {"state": drives()["state"] * np.where(np.arange(12) < 3, 100, 1)},
        "state: .*100 times as long",
    ),
    "shape of forces": ({"wheel_force": np.zeros((25, 41, 3))}, r"wheel_force: expected shape"),
    "NaN sinkage": ({"wheel_sinkage": spoilt("wheel_sinkage", np.nan)}, "wheel_sinkage: .*in m"),
    "sinkage in mm": ({"wheel_sinkage": spoilt("wheel_sinkage", 50.0)}, "wheel_sinkage: .*in m"),
    "wheels in deg/s": ({"wheel_omega": spoilt("wheel_omega", 4000.0)}, "wheel_omega: .*rad/s"),
    "infinite force": ({"chassis_force": spoilt("chassis_force", np.inf)}, "chassis_force: .*in N"),
    "steered in degrees": ({"steer_angle": spoilt("steer_angle", 15.0)}, "steer_angle: .*in rad"),
    "no classes, no wheels": ({"wheel_class": None}, "missing wheel_class, and meta: expected veh"),
    "no classes, bad wheels": (
        {
            "wheel_class": None,
            "meta": np.array('{"map": "hill.npz", "vehicle": {"wheels_in_body_xy": [[1, 1]]}}'),
        },
        "missing wheel_class, and meta: expected vehicle",
    ),
    "broken JSON": ({"meta": np.array("{")}, "meta: expected JSON"),
    "no map in meta": ({"meta": np.array("{}")}, "meta: expected JSON"),
    "map not a name": ({"meta": np.array('{"map": 3}')}, "meta: expected JSON"),
    "absent map": ({"meta": np.array('{"map": "x.npz"}')}, "meta: its map x.npz was expected at"),
    "pickled array": ({"state": np.array([{}], object)}, "expected an .npz archive of plain arr"),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_defect_is_one_error_that_names_file_and_field(tmp_path, defect):
    changes, message = DEFECTS[defect]
    path = write(tmp_path, **changes)
    with pytest.raises(DataError, match=message) as caught:
        dataset.load_drives(tmp_path, "test")
    assert str(caught.value).startswith(f"{path}: ")


def test_values_after_the_end_of_a_drive_are_not_looked_at(tmp_path):
    length = np.full(25, STEPS, np.int32)
    length[3] = 6
    state, sinkage = broken("state", (3, 7), np.nan), spoilt("wheel_sinkage", np.nan)
    write(tmp_path, state=state, wheel_sinkage=sinkage, length=length)
    dataset.load_drives(tmp_path, "train")


def test_a_vehicle_that_stands_still_tells_no_scale(tmp_path):
    write(tmp_path, state=np.zeros((25, STEPS + 1, 12)))
    dataset.load_drives(tmp_path, "train")


@pytest.mark.parametrize("content", [b"", b"not an archive", b"PK\x03\x04 cut off"])
def test_a_corrupt_file_is_named(tmp_path, content):
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(DataError, match=r"a\.npz: expected an \.npz archive"):
        dataset.load_drives(tmp_path, "test")


def test_a_truncated_file_is_named(tmp_path):
    path = write(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match=r"a\.npz: expected an \.npz archive"):
        dataset.load_drives(tmp_path, "test")


def test_an_array_instead_of_an_archive_is_named(tmp_path):
    with (tmp_path / "a.npz").open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(DataError, match=r"a\.npz: expected an \.npz archive"):
        dataset.load_drives(tmp_path, "test")


@pytest.mark.parametrize("write_archive", [np.savez, np.savez_compressed])
def test_damage_anywhere_in_an_archive_is_one_error_or_none(tmp_path, write_archive):
    path = write(tmp_path)
    write_archive(path, **drives(count=2), **wheel_signals(count=2))
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    named = 0
    for place in rng.integers(0, len(content), 300):
        damaged = bytearray(content)
        damaged[place] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            schema.read(path)
        except DataError as error:
            named += str(error).startswith(f"{path}: ")
    assert named > 200


def skid(turn: str = "yaw_rate") -> np.ndarray:
    return np.array(json.dumps({"map": "hill.npz", "vehicle": {"turn": turn}}))


def test_files_of_skid_steered_vehicles_tell_yaw_rates(tmp_path):
    turning = broken("control", (0, slice(None), 1), 5.0)
    write(tmp_path, control=turning, meta=skid())
    found, _ = dataset.load_drives(tmp_path, "all")
    assert found.turn == "yaw_rate" and np.asarray(found.control)[0, 0, 1] == 5.0
    found.expect_steered_by(vehicle.load("husky"))
    with pytest.raises(DataError, match=r"vehicle: expected one skid-steered, .* yaw rate, found"):
        found.driven(vehicle.load("hmmwv").vehicle)
    write(tmp_path, control=broken("control", (0, 3, 1), 40.0), meta=skid())
    with pytest.raises(DataError, match="control: expected finite commanded yaw rate in rad/s"):
        dataset.load_drives(tmp_path, "all")


def test_commands_of_two_kinds_are_not_mixed(tmp_path):
    write(tmp_path)
    front, _ = dataset.load_drives(tmp_path, "all")
    assert front.turn == "steering"
    with pytest.raises(DataError, match="expected one with front wheels that steer"):
        front.expect_steered_by(vehicle.load("husky"))
    write(tmp_path, "b.npz", meta=skid())
    with pytest.raises(DataError, match=r"b\.npz: meta: expected vehicle\.turn steering"):
        dataset.load_drives(tmp_path, "all")
    write(tmp_path, "b.npz", meta=skid("wheel speeds"))
    with pytest.raises(DataError, match=r"expected vehicle\.turn steering or yaw_rate, found 'wh"):
        dataset.load_drives(tmp_path, "all")
