import importlib.util
from pathlib import Path

import jax
import numpy as np
import pytest
from learning.recordings import STEPS, drives, wheel_signals, write

from vertiwm_jax.learning import dataset, windows
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import TerrainMap

SHIPPED = Path(__file__).parents[2] / "data" / "open"
KINDS = ("rigid", "deformable", "mixed")

if not SHIPPED.is_dir():
    pytest.skip("the drives are in the repository only", allow_module_level=True)
_spec = importlib.util.spec_from_file_location("compact", SHIPPED / "compact.py")
assert _spec is not None and _spec.loader is not None
compact = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(compact)


def collections(folder: Path) -> Path:
    """Two collections, one with its maps inside and one with them beside."""
    rng = np.random.default_rng(0)
    for kind in ("rigid", "mixed"):
        (folder / kind).mkdir(parents=True)
        state = drives()["state"] + rng.normal(0, 1e-3, (25, STEPS + 1, 12))
        length = np.full(25, STEPS, np.int32)
        length[2] = 30
        write(folder / kind, state=state, length=length, driver=np.ones(9), **wheel_signals())
        hill = TerrainMap.from_array(rng.uniform(0, 9, (9, 9)), np.full((4, 4), 3))
        files.save(hill, folder / kind / "maps" / "hill.npz")
    (folder / "mixed" / "maps").rename(folder / "maps")
    return folder


def test_compact_drives_are_the_recorded_ones_to_half_a_step(tmp_path):
    source = collections(tmp_path / "raw")
    compact.write(source, tmp_path / "compact")
    kinds = ("rigid", "mixed")
    ours, our_maps = dataset.load_drives([tmp_path / "compact" / kind for kind in kinds], "train")
    theirs, their_maps = dataset.load_drives([source / kind for kind in kinds], "train")
    places = windows.index(theirs, their_maps, context=4, horizon=4)
    ours, theirs = (windows.gather(drives, places) for drives in (ours, theirs))
    arrays = {"state": (ours.state, theirs.state), "control": (ours.control, theirs.control)}
    for name, recorded in vars(theirs.wheels).items():
        arrays[name] = (getattr(ours.wheels, name), recorded)
    assert arrays.keys() == compact.STEPS.keys()
    for name, (stored, recorded) in arrays.items():
        error = np.abs(np.asarray(stored, np.float64) - recorded)
        assert (error <= 0.5 * compact.STEPS[name] * (1 + 1e-6)).all(), name
        steps = np.asarray(stored, np.float64) / compact.STEPS[name]
        np.testing.assert_array_equal(steps, np.round(steps))
    height_error = np.abs(np.asarray(our_maps.elevation - their_maps.elevation))
    assert 0 < height_error.max() <= 0.5 * compact.ELEVATION_STEP * (1 + 1e-6)


def test_what_nothing_reads_is_left_out(tmp_path):
    compact.write(collections(tmp_path / "raw"), tmp_path / "compact")
    with np.load(tmp_path / "compact" / "rigid" / "a.npz") as archive:
        assert "driver" not in archive
        np.testing.assert_array_equal(
            archive["state"][2, 31:], archive["state"][2, 30:31].repeat(10, 0)
        )
        assert archive["wheel_class"].dtype == np.uint8


def test_the_same_drives_give_the_same_bytes(tmp_path):
    source = collections(tmp_path / "raw")
    for name in ("first", "second"):
        compact.write(source, tmp_path / name)
    first, second = (sorted((tmp_path / name).rglob("*.npz")) for name in ("first", "second"))
    assert len(first) == len(second) == 4
    for a, b in zip(first, second, strict=True):
        assert a.read_bytes() == b.read_bytes()


def test_compacting_again_changes_no_number(tmp_path):
    compact.write(collections(tmp_path / "raw"), tmp_path / "once")
    compact.write(tmp_path / "once", tmp_path / "twice")
    once, twice = (
        dataset.load_drives(tmp_path / name / "rigid", "train") for name in ("once", "twice")
    )
    jax.tree.map(np.testing.assert_array_equal, once[0], twice[0])
    np.testing.assert_array_equal(once[1].elevation, twice[1].elevation)


def test_the_command_prints_sizes_and_ends_in_one_line_when_it_fails(tmp_path, capsys):
    source = collections(tmp_path / "raw")
    compact.main([str(source), str(tmp_path / "compact")])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["mixed", "rigid", "maps", "rigid/maps", "all"]
    with pytest.raises(SystemExit, match=r"^error: .*expected folders with \.npz files of drives"):
        compact.main([str(tmp_path / "nothing"), str(tmp_path / "compact")])
    with pytest.raises(SystemExit, match=r"^error: .*expected another folder than that"):
        compact.main([str(source), str(source)])
    (source / "mixed" / "a.npz").write_bytes(b"")
    with pytest.raises(SystemExit, match=r"^error: .*a\.npz: expected an \.npz archive"):
        compact.main([str(source), str(tmp_path / "compact")])


def test_the_shipped_drives_are_whole():
    sizes = [file.stat().st_size for file in SHIPPED.rglob("*") if file.is_file()]
    assert sum(sizes) < 25e6
    for split, count in (("train", 20), ("validation", 2), ("test", 3)):
        drives, terrain = dataset.load_drives([SHIPPED / kind for kind in KINDS], split)
        assert terrain.worlds == 48
        np.testing.assert_array_equal(drives.world, np.repeat(np.arange(48), count))
        assert drives.state.shape == (48 * count, 251, 12)
        assert drives.length.min() > 200
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(drives))
        assert len(jax.tree.leaves(drives.wheels)) == 5
        ground = windows.index(drives, terrain).ground
        assert (np.bincount(ground, minlength=3) > 100).all()
