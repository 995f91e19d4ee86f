import json
import shutil
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from learning.recordings import GRASS, SNOW, STEPS, drives, wheel_signals, write

from vertiwm_jax.config import ConfigError
from vertiwm_jax.learning import dataset, pipeline
from vertiwm_jax.learning.dataset import Collection, SplitConfig
from vertiwm_jax.learning.pipeline import KINDS, PipelineConfig
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.classes import STANDARD, GroundClasses
from vertiwm_jax.terrain.map import MapError, TerrainMap

OPEN = Path(__file__).parents[2] / "data" / "open"


@pytest.mark.parametrize(
    ("split", "first", "count"), [("train", 0, 20), ("validation", 20, 2), ("test", 22, 3)]
)
def test_a_split_is_its_drives_of_every_file(tmp_path, split, first, count):
    write(tmp_path, "b.npz", length=np.full(25, STEPS - 1, np.int32))
    write(tmp_path, "a.npz")
    loaded, terrain = dataset.load_drives(tmp_path, split)
    assert terrain.worlds == 2
    np.testing.assert_array_equal(loaded.world, np.repeat([0, 1], count))
    np.testing.assert_array_equal(loaded.length, np.repeat([STEPS, STEPS - 1], count))
    expected = drives()["state"][first : first + count]
    np.testing.assert_array_equal(loaded.state, np.concatenate([expected, expected]))


def purposes(folder, splits=SplitConfig()):
    """What each drive is for, `[K]` of every file, by its name without ending."""
    collection = Collection.of(folder, splits)
    return {path.stem: found.tolist() for path, found in collection.purposes.items()}


def runs(*counts):
    """Purposes in a row: so many to train, for validation, to test, to train, ..."""
    return np.repeat(np.resize(dataset.SPLITS, len(counts)), counts).tolist()


@pytest.mark.parametrize(
    ("count", "expected"),
    [
        (1, (1,)),
        (2, (2,)),
        (3, (1, 1, 1)),
        (5, (3, 1, 1)),
        (10, (8, 1, 1)),
        (25, (20, 2, 3)),
        (50, (20, 2, 3, 20, 2, 3)),
        (500, (20, 2, 3) * 20),
    ],
)
def test_drives_are_shared_out(tmp_path, count, expected):
    write(tmp_path, **drives(count=count))
    assert purposes(tmp_path) == {"a": runs(*expected)}


@pytest.mark.parametrize("count", [3, 4, 7, 24, 26, 99, 501])
@pytest.mark.parametrize("shares", [(0.8, 0.08, 0.12), (0.5, 0.25, 0.25), (0.1, 0.0, 0.9)])
def test_shares_are_kept_to_a_drive_and_each_has_one(count, shares):
    found = SplitConfig(shares).of(count).tolist()
    for split, share in zip(dataset.SPLITS, shares, strict=True):
        got = found.count(split)
        assert (got > 0) == (share > 0)
        # Those that get one in spite of a small share take it from others.
        assert got >= share * count - 2 and got <= max(1, share * count + 1)


def test_files_of_one_drive_are_shared_out_together(tmp_path):
    for i in range(25):
        write(tmp_path, f"{i:02d}.npz", **drives(count=1))
    assert list(chain(*purposes(tmp_path).values())) == runs(20, 2, 3)
    loaded, terrain = dataset.load_drives(tmp_path, "test")
    # Of maps without a drive nothing is loaded.
    assert len(loaded.length) == terrain.worlds == 3


def test_few_drives_in_several_files_are_shared_out_together(tmp_path):
    for name, count in (("a", 4), ("b", 1), ("c", 5)):
        write(tmp_path, f"{name}.npz", **drives(count=count))
    assert purposes(tmp_path) == {"a": runs(4), "b": runs(1), "c": runs(3, 1, 1)}


def test_whole_worlds_are_shared_out(tmp_path):
    hill = write(tmp_path) and tmp_path / "maps" / "hill.npz"
    (tmp_path / "a.npz").unlink()
    # Worlds of unequal numbers of drives; one of them in two files.
    of = {"a": "m0", "b": "m1", "c": "m1", "d": "m2", "e": "m3", "f": "m4"}
    for i, (name, ground) in enumerate(of.items()):
        shutil.copy(hill, tmp_path / "maps" / f"{ground}.npz")
        meta = np.array(json.dumps({"map": f"{ground}.npz"}))
        write(tmp_path, f"{name}.npz", **drives(count=i + 1) | {"meta": meta})
    found = purposes(tmp_path, SplitConfig(whole="worlds"))
    assert {name: set(split) for name, split in found.items()} == {
        **{name: {"train"} for name in "abcd"},
        "e": {"validation"},
        "f": {"test"},
    }
    collection = Collection.of(tmp_path, SplitConfig(whole="worlds"))
    assert str(collection).endswith("10 train, 5 validation, 6 test (by share of worlds)")


def test_what_files_say_is_kept(tmp_path):
    said = np.array(["test", "train", "test"])
    write(tmp_path, "a.npz", **drives(count=3), split=said)
    write(tmp_path, "b.npz", **drives(count=10))
    splits = SplitConfig((0.5, 0.0, 0.5))
    expected = {"a": said.tolist(), "b": ["train"] * 5 + ["test"] * 5}
    assert purposes(tmp_path, splits) == expected
    loaded, _ = dataset.load_drives(tmp_path, "test", splits)
    np.testing.assert_allclose(loaded.state[:2, 0, 6], [1.0, 1.2])
    assert str(Collection.of(tmp_path, splits)) == (
        f"{tmp_path}: 13 drives: 6 train, 0 validation, 7 test (as files say, by share of drives)"
    )


@pytest.mark.parametrize(
    ("split", "message"),
    [
        (np.array(["train", "tset", "test"]), "found tset"),
        (np.array(["train"]), r"found \[1\]"),
        (np.array([0, 1, 2]), "found 0"),
        (np.array("train"), r"found \[\]"),
    ],
)
def test_what_no_drive_is_for_is_refused(tmp_path, split, message):
    path = write(tmp_path, **drives(count=3), split=split)
    expected = "split: expected one of train, validation, test for each of 3 drives, "
    with pytest.raises(DataError, match=f"{expected}{message}") as caught:
        dataset.load_drives(tmp_path, "train")
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize("count", [24, 25])
def test_what_the_shipped_models_learned_from_stays_as_it_was(tmp_path, count):
    meta = np.array(json.dumps({"map": "hill.npz", "steering_amplitude": [0.2, 1.0]}))
    write(tmp_path, **drives(count=count) | {"meta": meta})
    found = purposes(tmp_path, SplitConfig((0.0, 0.5, 0.5)))["a"]
    assert found == (runs(20, 2, 3) if count == 25 else runs(0, 12, 12))


def test_the_drives_of_the_tests_and_the_open_ones_say_what_they_are_for():
    tests = Path(__file__).parents[1] / "data" / "chrono_drives"
    assert set(chain(*purposes(tests).values())) == {"train"}
    everything = SplitConfig((0.0, 0.0, 1.0))
    for kind in ("rigid", "deformable", "mixed"):
        found = purposes(tests.parents[2] / "data" / "open" / kind, everything)
        assert len(found) == 16 and all(split == runs(20, 2, 3) for split in found.values())


def test_all_drives_are_taken_if_asked_for(tmp_path):
    write(tmp_path)
    loaded, _ = dataset.load_drives(tmp_path, "all")
    np.testing.assert_array_equal(loaded.state, drives()["state"])


@pytest.mark.parametrize(
    ("shares", "found"),
    [((0.8, 0.1, 0.2), "1.1"), ((1.0, 0.5, -0.5), "-0.5"), ((np.nan,) * 3, "nan")],
)
def test_shares_that_are_no_shares_are_refused(shares, found):
    with pytest.raises(ConfigError, match=f"shares: expected .*, found .*{found}"):
        SplitConfig(shares)


def test_a_map_beside_the_collection_is_found(tmp_path):
    collection = tmp_path / "rigid"
    collection.mkdir()
    write(collection)
    (collection / "maps").rename(tmp_path / "maps")
    _, terrain = dataset.load_drives(collection, "test")
    assert terrain.worlds == 1


def test_an_empty_folder_and_an_empty_split_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"expected a folder with \.npz files"):
        dataset.load_drives(tmp_path, "test")
    write(tmp_path, **drives(count=3))
    for split in dataset.SPLITS:
        assert len(dataset.load_drives(tmp_path, split)[0].length) == 1
    write(tmp_path, **drives(count=2))
    for split in ("validation", "test"):
        expected = f"expected drives of the {split} split, found none; record more"
        with pytest.raises(DataError, match=expected) as caught:
            dataset.load_drives(tmp_path, split)
        told = f"{tmp_path}: 2 drives: 2 train, 0 validation, 0 test (too few to share out): "
        assert str(caught.value).startswith(told)
    for split in ("train", "all"):
        assert len(dataset.load_drives(tmp_path, split)[0].length) == 2


def test_no_folder_at_all_is_refused():
    with pytest.raises(DataError, match="drives: expected a folder of drives or more, found none"):
        dataset.load_drives([])


def test_drives_of_unequal_length_are_padded(tmp_path):
    write(tmp_path, "a.npz", **drives(steps=30), **wheel_signals(steps=30))
    write(tmp_path, "b.npz", **wheel_signals())
    loaded, _ = dataset.load_drives(tmp_path, "test")
    assert loaded.length.tolist() == [30, 30, 30, STEPS, STEPS, STEPS]
    assert loaded.state.shape == (6, STEPS + 1, 12)
    assert loaded.control.shape == (6, STEPS, 2)
    assert loaded.wheels.wheel_force.shape == (6, STEPS + 1, 4, 3)
    np.testing.assert_array_equal(loaded.state[:3, :31], drives()["state"][22:, :31])
    np.testing.assert_array_equal(loaded.state[3:], drives()["state"][22:])


def test_what_was_recorded_beside_the_states_comes_along(tmp_path):
    recorded = wheel_signals()
    write(tmp_path, **{name: recorded[name] for name in ("wheel_omega", "chassis_force")})
    loaded, _ = dataset.load_drives(tmp_path, "validation")
    np.testing.assert_array_equal(loaded.wheels.wheel_omega, recorded["wheel_omega"][20:22])
    np.testing.assert_array_equal(loaded.wheels.chassis_force, recorded["chassis_force"][20:22])
    assert loaded.wheels.wheel_sinkage is None
    assert loaded.wheels.wheel_force is None
    assert loaded.wheels.steer_angle is None


def test_half_a_recording_is_refused(tmp_path):
    write(tmp_path, "a.npz", **wheel_signals())
    path = write(tmp_path, "b.npz", **{**wheel_signals(), "wheel_omega": None})
    with pytest.raises(
        DataError, match=r"wheel_omega: expected in all files .* missing in 1 of 2"
    ) as caught:
        dataset.load_drives(tmp_path, "train")
    assert str(caught.value).startswith(f"{path}: ")
    drives, _ = dataset.load_drives(tmp_path, "train", wheels=False)
    assert drives.wheels == dataset.WheelSignals()


def far_away(folder, state):
    path = write(folder, state=state)
    hill = TerrainMap.from_array(np.ones((9, 9)), np.full((4, 4), GRASS), origin=(5e5, 5e6))
    files.save(hill, folder / "maps" / "hill.npz")
    return path


def test_drives_on_a_far_map_are_brought_to_its_coordinates(tmp_path):
    near, place = drives()["state"], np.pad([5e5 + 4, 5e6 - 4], (0, 10))
    path = far_away(tmp_path, near + place)
    found, terrain = dataset.load_file(path)
    assert found.state.dtype == np.float32
    np.testing.assert_allclose(found.state, near, atol=1e-6)
    np.testing.assert_array_equal(terrain.offset(), place[:2])
    rounded = (near + place).astype(np.float32)
    for state, message in (
        (rounded, r"state: expected float64, because .* about \(500004, 4999996\) m, .* float32"),
        (near.astype(float), r"state: expected finite position in m within 1e\+05"),
        (near + place + np.pad([2e3, 0], (0, 10)), r"state: expected positions on its map, x from "
            r"500000 to 500008 m and y .*, found none, the first is \(502004, 4999996\)"),
    ):  # fmt: skip
        far_away(tmp_path, state)
        with pytest.raises(DataError, match=r"a\.npz: " + message):
            dataset.load_file(path)


def test_precision_in_the_file_does_not_matter(tmp_path):
    write(tmp_path, "a.npz", state=drives()["state"].astype(np.float64))
    write(tmp_path, "b.npz", state=drives()["state"].astype(np.float16))
    loaded, _ = dataset.load_drives(tmp_path, "train")
    assert loaded.state.dtype == np.float32
    np.testing.assert_allclose(loaded.state[:20], loaded.state[20:], rtol=1e-3)


def test_missing_classes_are_those_of_the_map_under_the_wheels(tmp_path):
    # West of x = 0 grass, east of it snow; the vehicle is 3 m long, 1 m wide and heads north-west.
    wheels = [[1.5, 0.5], [1.5, -0.5], [-1.5, 0.5], [-1.5, -0.5]]
    meta = np.array(json.dumps({"map": "hill.npz", "vehicle": {"wheels_in_body_xy": wheels}}))
    state = np.zeros((25, STEPS + 1, 12), np.float32)
    state[..., 5] = 3 * np.pi / 4
    state[..., 0] = np.linspace(-2, 2, STEPS + 1)
    write(tmp_path, state=state, wheel_class=None, meta=meta)
    semantic = np.where(np.arange(4) < 2, GRASS, SNOW) * np.ones((4, 1), int)
    files.save(TerrainMap.from_array(np.ones((9, 9)), semantic), tmp_path / "maps" / "hill.npz")
    loaded, _ = dataset.load_drives(tmp_path, "test")
    east = state[22:, :, None, 0] - (np.array(wheels) @ [1, 1]) / np.sqrt(2)
    np.testing.assert_array_equal(loaded.wheel_class, np.where(east < 0, GRASS, SNOW))


def test_collections_are_loaded_together(tmp_path):
    for name, height in (("rigid", 1.0), ("mixed", 2.0)):
        (tmp_path / name).mkdir()
        write(tmp_path / name, "a.npz")
        write(tmp_path / name, "b.npz")
        hill = TerrainMap.from_array(np.full((9, 9), height), np.full((4, 4), GRASS))
        files.save(hill, tmp_path / name / "maps" / "hill.npz")
    loaded, terrain = dataset.load_drives([tmp_path / "rigid", tmp_path / "mixed"], "test")
    np.testing.assert_array_equal(loaded.world, np.repeat([0, 1, 2, 3], 3))
    np.testing.assert_array_equal(terrain.elevation[:, 0, 0], [1, 1, 2, 2])


def test_collections_of_other_classes_are_refused(tmp_path):
    for name in ("own", "standard"):
        (tmp_path / name).mkdir()
        path = write(tmp_path / name)
    names = ("moss", *STANDARD.names[1:])
    classes = GroundClasses(names, STANDARD.rgb, STANDARD.friction, STANDARD.soils)
    moss = TerrainMap.from_array(np.ones((9, 9)), np.full((4, 4), GRASS), ground=classes)
    files.save(moss, tmp_path / "own" / "maps" / "hill.npz")
    with pytest.raises(MapError, match="class_names: expected") as caught:
        dataset.load_drives([tmp_path / "own", tmp_path / "standard"], "test")
    assert str(caught.value).startswith(f"map of {path}: ")


def test_vehicles_are_named_as_the_files_say(tmp_path):
    said = [{"name": "uaz", "model": "UAZBUS"}, {"model": "HMMWV_Reduced"}, {}, None]
    for i, facts in enumerate(said):
        meta = {"map": "hill.npz"} | ({} if facts is None else {"vehicle": facts})
        write(tmp_path, f"{i}.npz", meta=np.array(json.dumps(meta)))
    loaded, _ = dataset.load_drives(tmp_path, "test")
    assert loaded.vehicles == ("uaz", "HMMWV_Reduced", "unnamed", "unnamed")


def test_each_world_has_the_vehicle_that_its_file_describes(tmp_path):
    wheel = [[1.2, 0.7], [1.2, -0.7], [-1.2, 0.7], [-1.2, -0.7]]
    facts = {
        **{"name": "van", "mass": 2800.0, "inertia": np.diag([900.0, 3000.0, 3400.0]).tolist()},
        **{"com_in_body": [0.0, 0.0, 0.2], "wheels_in_body_xy": wheel, "wheel_radius": 0.37},
        **{"wheel_width": 0.2, "wheel_height_at_rest": [0.01] * 4, "pedal_gain": 1.0},
        "wheel_load_at_rest": [6867.0] * 4,
        "front_angle": {"0.5": 0.2, "1.0": 0.4, "-0.5": -0.2, "-1.0": -0.4},
        "bench": {"start": [0.5, 1.1, 1.6, 2.1, 2.5], "stop": [2.0, 1.5, 1.0, 0.5, 0.0]},
    }
    for name, said in (("a", facts), ("b", {"name": "van"})):
        meta = np.array(json.dumps({"map": "hill.npz", "vehicle": said}))
        write(tmp_path, f"{name}.npz", meta=meta)
    loaded, terrain = dataset.load_drives(tmp_path, "test")
    driven = loaded.driven(vehicle.load_vehicle())
    assert driven.mass.shape == (terrain.worlds,)
    np.testing.assert_allclose(driven.mass, [2800.0, 2493.6])
    own = driven.select(loaded.world[0])
    np.testing.assert_allclose(own.wheel_position, wheel, atol=1e-6)
    assert loaded.described[1] is None

    meta = np.array(json.dumps({"map": "hill.npz", "vehicle": facts | {"mass": 0.0}}))
    path = write(tmp_path, "c.npz", meta=meta)
    with pytest.raises(ConfigError, match=r"mass: expected more than 0, found 0\.0") as refused:
        dataset.load_drives(tmp_path, "test")
    assert str(refused.value).startswith(f"{path}: meta.vehicle: mass: ")


def test_worlds_that_are_left_out_are_only_to_test(tmp_path):
    folder = tmp_path / "open" / "rigid"
    folder.mkdir(parents=True)
    for name in ("rigid_012", "other_012", "rigid_013"):
        write(folder, f"{name}.npz", **drives(count=25))
    splits = SplitConfig(leave_out=("rigid/rigid_012", "mixed/rigid_013", "igid_013", "012"))
    collection = Collection.of(folder, splits)
    counts = {
        split: [len(collection.rows(path, split)) for path in collection.lengths]
        for split in ("train", "validation", "test", "unseen", "all")
    }
    pattern = Collection.of(folder, SplitConfig(leave_out=("rigid/rigid_*",)))
    assert [len(pattern.rows(path, "unseen")) for path in pattern.lengths] == [0, 25, 25]
    # In the order other_012, rigid_012, rigid_013: only whole names of files and folders count.
    assert counts == {
        "train": [20, 0, 20],
        "validation": [2, 0, 2],
        "test": [3, 3, 3],
        "unseen": [0, 25, 0],
        "all": [25, 25, 25],
    }
    assert "75 drives: 40 train, 4 validation, 9 test, 22 unseen" in str(collection)
    loaded, terrain = dataset.load_drives(folder, "unseen", splits)
    assert len(loaded.state) == 25 and terrain.worlds == 1
    with pytest.raises(DataError, match="expected drives of the unseen split, found none"):
        dataset.load_drives(folder, "unseen")


@pytest.mark.integration
def test_the_unseen_worlds_are_four_of_each_kind_from_low_to_high(monkeypatch):
    monkeypatch.chdir(OPEN)  # However the folder is named, the worlds are found.
    found = [Collection.of(kind, dataset.FITTED) for kind in KINDS]
    names = [name for collection in found for name in collection.left_out.values()]
    assert sorted(names) == sorted(x for x in dataset.UNSEEN if x.startswith("open"))
    for collection in found:
        steep = []
        for path in collection.left_out:
            elevation = np.asarray(files.load_map(OPEN / "maps" / path.name).elevation[0])
            steep.append(np.abs(np.gradient(elevation)).mean())
            assert len(collection.rows(path, "train")) == 0
        assert min(steep) < 0.08 < 0.1 < max(steep)
        assert len(steep) == 4
        assert "320 train" not in str(collection) and "240 train" in str(collection)


def test_a_fit_leaves_the_unseen_worlds_out(tmp_path):
    folder = tmp_path / "open" / "mixed"
    folder.mkdir(parents=True)
    for name in ("mixed_015", "mixed_017"):
        write(folder, f"{name}.npz", **drives(count=25))
    config = PipelineConfig(data=(folder.parent,))
    (found,) = pipeline.expect_drives(config)
    assert found.left_out == {folder / "mixed_015.npz": "open/mixed/mixed_015"}
    for split, count in (("train", 20), ("validation", 2)):
        shared = pipeline._Pipeline(config, None, (), True, vehicle.load_vehicle())
        loaded, terrain = shared.load(("mixed",), split)
        assert len(loaded.state) == count and terrain.worlds == 1
    misspelt = SplitConfig(leave_out=("mixed/mixed_17",))
    with pytest.raises(DataError, match=r"leave_out: .* found mixed/mixed_17, which is not in"):
        pipeline.expect_drives(PipelineConfig(data=(folder.parent,), splits=misspelt))
