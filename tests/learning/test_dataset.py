import json
from pathlib import Path

import numpy as np
import pytest

from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.dataset import GROUNDS, DataError
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain import map as terrain_map

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
    hill = terrain_map.build(np.ones((9, 9)), np.full((4, 4), GRASS))
    files.save(hill, folder / "maps" / "hill.npz")
    np.savez(folder / name, **{k: v for k, v in arrays.items() if v is not None})
    return folder / name


@pytest.mark.parametrize(
    ("split", "first", "count"), [("train", 0, 20), ("validation", 20, 2), ("test", 22, 3)]
)
def test_a_split_is_its_drives_of_every_file(tmp_path, split, first, count):
    write(tmp_path, "b.npz", length=np.full(25, STEPS - 1, np.int32))
    write(tmp_path, "a.npz")
    loaded, terrain = dataset.load(tmp_path, split)
    assert terrain.worlds == 2
    np.testing.assert_array_equal(loaded.world, np.repeat([0, 1], count))
    np.testing.assert_array_equal(loaded.length, np.repeat([STEPS, STEPS - 1], count))
    expected = drives()["state"][first : first + count]
    np.testing.assert_array_equal(loaded.state, np.concatenate([expected, expected]))


def test_splits_share_no_drive():
    every = [i for split in dataset.SPLITS.values() for i in split]
    assert sorted(every) == list(range(25))


def test_a_map_beside_the_collection_is_found(tmp_path):
    collection = tmp_path / "rigid"
    collection.mkdir()
    write(collection)
    (collection / "maps").rename(tmp_path / "maps")
    _, terrain = dataset.load(collection, "test")
    assert terrain.worlds == 1


def test_windows_hold_consecutive_steps_within_the_valid_ones(tmp_path):
    length = np.full(25, STEPS, np.int32)
    length[23] = 21
    write(tmp_path, length=length)
    loaded, terrain = dataset.load(tmp_path, "test")
    windows = dataset.cut(loaded, terrain, context=12, horizon=8, stride=5)
    # (40 - 20) // 5 + 1 of the drives of 40 steps, one of the drive of 21.
    speeds = np.asarray(windows.state[:, 0, 6])
    np.testing.assert_allclose(np.unique(speeds, return_counts=True)[0], [3.2, 3.3, 3.4])
    assert np.unique(speeds, return_counts=True)[1].tolist() == [5, 1, 5]
    assert windows.state.shape == (11, 21, 12)
    assert windows.control.shape == (11, 20, 2)
    assert windows.context == 12
    driven = np.diff(np.asarray(windows.state[..., 0]), axis=1)
    np.testing.assert_allclose(driven, np.tile(0.1 * speeds[:, None], 20), atol=1e-5)
    starts = np.asarray(windows.state[:5, 0, 0]) / (0.1 * 3.2)
    np.testing.assert_allclose(starts, [0, 5, 10, 15, 20], atol=1e-4)


def test_ground_of_a_window_is_that_under_its_predicted_steps(tmp_path):
    classes = np.full((25, STEPS + 1, 4), GRASS, np.uint8)
    classes[23] = SNOW
    classes[24, :11] = SNOW  # Context only.
    classes[22, 15:, 0] = SNOW
    write(tmp_path, wheel_class=classes)
    loaded, terrain = dataset.load(tmp_path, "test")
    windows = dataset.cut(loaded, terrain, context=12, horizon=8, stride=100)
    assert [GROUNDS[i] for i in windows.ground] == ["transition", "deformable", "rigid"]


def test_drives_shorter_than_a_window_are_refused(tmp_path):
    write(tmp_path)
    loaded, terrain = dataset.load(tmp_path, "test")
    with pytest.raises(DataError, match="at least 60 steps, found at most 40"):
        dataset.cut(loaded, terrain, context=30, horizon=30)


def broken(name: str, place: tuple, value: float) -> np.ndarray:
    array = drives()[name]
    array[place] = value
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
        dataset.load(tmp_path, "test")
    assert str(caught.value).startswith(f"{path}: ")


def test_values_after_the_end_of_a_drive_are_not_looked_at(tmp_path):
    length = np.full(25, STEPS, np.int32)
    length[3] = 20
    write(tmp_path, state=broken("state", (3, 21), np.nan), length=length)
    dataset.load(tmp_path, "train")


@pytest.mark.parametrize("content", [b"", b"not an archive", b"PK\x03\x04 cut off"])
def test_a_corrupt_file_is_named(tmp_path, content):
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(DataError, match=r"a\.npz: expected an \.npz archive"):
        dataset.load(tmp_path, "test")


def test_a_truncated_file_is_named(tmp_path):
    path = write(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match=r"a\.npz: expected an \.npz archive"):
        dataset.load(tmp_path, "test")


def test_files_of_unequal_drives_are_refused(tmp_path):
    write(tmp_path, "a.npz")
    write(tmp_path, "b.npz", **drives(steps=30))
    with pytest.raises(DataError, match=r"equally long drives, found \[30, 40\]"):
        dataset.load(tmp_path, "test")


def test_an_empty_folder_and_an_empty_split_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"expected a folder with \.npz files"):
        dataset.load(tmp_path, "test")
    write(tmp_path, **drives(count=3))
    with pytest.raises(DataError, match="expected drives 22 to 24 of a file"):
        dataset.load(tmp_path, "test")
    loaded, _ = dataset.load(tmp_path, "train")
    assert len(loaded.length) == 3
