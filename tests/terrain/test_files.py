import json
import sys

import jax
import numpy as np
import pytest
from disks import full_disk
from PIL import Image

from vertiwm_jax.atomic import WriteError
from vertiwm_jax.errors import UserError
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain.classes import STANDARD, GroundClasses
from vertiwm_jax.terrain.map import MapError, TerrainMap

META = {
    "classes": STANDARD.names,
    "soil_fields": [
        "Bekker_Kphi", "Bekker_Kc", "Bekker_n", "Mohr_cohesion", "Mohr_friction_deg",
        "Janosi_shear", "elastic_K", "damping_R",
    ],
    "soils": {
        "mud": [2e6, 0.0, 1.1, 0.0, 30.0, 0.01, 2e8, 3e4],
        "sand": [5301e3, 102e3, 0.793, 1.3e3, 31.1, 0.012, 4e8, 3e4],
        "snow": [0.3e6, 0.0, 1.1, 0.0, 30.0, 0.01, 4e7, 3e4],
    },
}  # fmt: skip


def write_drive_map(path, drop=(), meta=META, **changes):
    """A map file as the Chrono drives have it."""
    rng = np.random.default_rng(0)
    semantic = rng.integers(0, 10, (4, 4)).astype(np.uint8)
    semantic[0, 0], semantic[0, 1] = 9, 1
    friction = np.where(semantic < 7, 0.5, np.nan).astype(np.float32)
    arrays = {
        "elevation": rng.uniform(0, 4, (33, 33)).astype(np.float32),
        "semantic": np.zeros((33, 33), np.uint8),
        "resolution": np.float32(1),
        "origin": np.array([-16, 16], np.float32),
        "class_rgb": STANDARD.rgb,
        "patch_class": semantic,
        "patch_friction": friction,
        "obstacles": np.array([[1, 2, 3, 4, 5]], np.float32),
        "meta": json.dumps(meta),
    }
    np.savez(path, **{k: v for k, v in (arrays | changes).items() if k not in drop})
    return path


def assert_same(a, b):
    assert a.class_names == b.class_names
    for ours, theirs in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)


def test_load_reads_a_map_of_the_drives(tmp_path):
    terrain = files.load_map(write_drive_map(tmp_path / "a.npz"))
    assert terrain.worlds == 1 and terrain.semantic.shape == (1, 4, 4)
    assert terrain.friction[0, 0, 0] == 0 and terrain.friction[0, 0, 1] == 0.5
    snow = STANDARD.names.index("snow")
    assert terrain.soils.kphi[0, snow] == pytest.approx(0.3e6)  # the file's, not the preset's
    assert terrain.soils.friction_angle[0, snow] == pytest.approx(np.pi / 6)
    assert terrain.soils.unit_weight[0, snow] == STANDARD.soils["snow"].unit_weight
    np.testing.assert_array_equal(terrain.deformable, np.arange(10) >= 7)


def test_a_folder_is_stacked_by_name(tmp_path):
    for name, height in (("b", 2), ("a", 1), ("c", 3)):
        write_drive_map(tmp_path / f"{name}.npz", elevation=np.full((33, 33), height, np.float32))
    np.testing.assert_array_equal(files.load_map(tmp_path).elevation[:, 0, 0], [1, 2, 3])
    write_drive_map(tmp_path / "d.npz", elevation=np.ones((17, 33), np.float32))
    with pytest.raises(MapError, match=r"d.npz: classes: expected square cells"):
        files.load_map(tmp_path)
    small = {"elevation": np.ones((17, 17), np.float32), "obstacles": np.zeros((0, 5))}
    write_drive_map(tmp_path / "d.npz", **small)
    with pytest.raises(MapError, match=r"d.npz: elevation: expected .* as in .*a.npz"):
        files.load_map(tmp_path)


def test_save_and_load_round_trip(tmp_path):
    first = files.load_map(write_drive_map(tmp_path / "a.npz"))
    files.save(first, tmp_path / "b.npz")
    assert_same(files.load_map(tmp_path / "b.npz"), first)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "b.npz"]


def test_a_far_map_is_saved_as_it_was_given(tmp_path):
    origin, boxes = np.array([512345.1, 5234567.7]), np.array([[512350.3, 5234560.9, 1, 2, 3]])
    heights = np.ones((1001, 1001))
    far = TerrainMap.from_array(heights, origin=origin, resolution=0.1, obstacles=boxes)
    for name in ("a.npz", "b.npz"):
        files.save(far, tmp_path / name)
        with np.load(tmp_path / name) as file:
            np.testing.assert_allclose(file["origin"], origin, rtol=0, atol=1e-8)
            np.testing.assert_allclose(file["obstacles"], boxes, rtol=0, atol=1e-5)
        again = files.load_map(tmp_path / name)
        assert_same(again, far)
        np.testing.assert_allclose(again.offset(), far.offset(), rtol=0, atol=1e-8)
        far = again
    large = files.load_map(tmp_path / "b.npz", scale=10.0)
    np.testing.assert_allclose(large.offset(), 10 * far.offset(), rtol=1e-12)
    np.testing.assert_allclose(large.origin, [-500, 500], rtol=1e-6)


def test_save_keeps_the_selected_world_and_classes_of_ones_own(tmp_path):
    classes = GroundClasses(
        names=("regolith", "plate"),
        rgb=np.array([[10, 20, 30], [200, 0, 0]], np.uint8),
        friction=np.array([0, 0.7], np.float32),
        soils={"regolith": STANDARD.soils["sand"].replace(kphi=np.float32(820e3))},
    )
    worlds = [
        TerrainMap.from_array(np.full((9, 9), height), [[0, 1], [1, 0]], ground=classes)
        for height in (-1, 2)
    ]
    files.save(terrain_map.stack(worlds).select(1), tmp_path / "moon.npz")
    assert_same(files.load_map(tmp_path / "moon.npz"), worlds[1])


def test_a_failed_save_leaves_the_old_file(tmp_path):
    terrain = files.load_map(write_drive_map(tmp_path / "a.npz"))
    before = (tmp_path / "a.npz").read_bytes()
    with full_disk(after=100), pytest.raises(WriteError, match=r"a\.npz: cannot write"):
        files.save(terrain, tmp_path / "a.npz")
    assert (tmp_path / "a.npz").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"drop": ["patch_class"]}, "file: .*patch_class is not a file in the archive"),
        ({"origin": np.zeros(3)}, "origin: expected finite x, y"),
        ({"patch_class": np.full((4, 4), 12)}, "classes: .* found 12"),
        ({"elevation": np.full((33, 33), np.nan)}, "elevation: .*1089 such"),
        ({"class_rgb": STANDARD.rgb[:4]}, r"class_rgb: expected shape \(10, 3\)"),
        ({"meta": {"classes": ["a"]}}, "file: .*KeyError: 'soils'"),
        ({"meta": META | {"soils": {"lava": []}}}, r"meta.soils: expected soils among .*lava"),
        ({"meta": META | {"soils": {"mud": [1.0]}}}, r"meta.soils.mud: expected 8 numbers"),
        (
            {"meta": META | {"soils": {"clay": META["soils"]["mud"]}}},
            r"meta.soils.clay: .* found no \['unit_weight'\]; add them",
        ),
    ],
)
def test_a_bad_map_is_named(tmp_path, changes, message):
    path = write_drive_map(tmp_path / "bad.npz", **changes)
    with pytest.raises(MapError, match=r"bad\.npz: " + message):
        files.load_map(path)


def test_what_is_no_map_is_named(tmp_path):
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(MapError, match=r"text.npz: file: expected an .npz map"):
        files.load_map(tmp_path / "text.npz")
    whole = write_drive_map(tmp_path / "cut.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(MapError, match=r"cut.npz: file: expected an .npz map"):
        files.load_map(tmp_path / "cut.npz")
    with pytest.raises(MapError, match=r"absent.npz: file: .*no such file"):
        files.load_map(tmp_path / "absent.npz")
    (tmp_path / "empty").mkdir()
    with pytest.raises(MapError, match=r"empty: folder: expected one .npz map or more"):
        files.load_map(tmp_path / "empty")


RAMP = np.linspace(0, 65535, 21 * 31).reshape(21, 31).astype(np.uint16)


def test_heightmap_from_a_16_bit_png(tmp_path):
    Image.fromarray(RAMP).save(tmp_path / "h.png")
    terrain = files.from_heightmap(tmp_path / "h.png", 0.5, height_range=(1, 9))
    assert terrain.elevation.shape == (1, 21, 31)
    np.testing.assert_allclose(terrain.elevation[0], 1 + 8 * (RAMP / 65535), atol=1e-5)
    np.testing.assert_allclose(terrain.origin, [-7.5, 5])
    assert (terrain.semantic == STANDARD.names.index("grass")).all()


def test_heightmap_in_metres_from_npy_and_geotiff(tmp_path):
    pytest.importorskip("rasterio")
    heights = (RAMP / 8000).astype(np.float32)
    np.save(tmp_path / "h.npy", heights)
    Image.fromarray(heights).save(tmp_path / "h.tif")
    for name in ("h.npy", "h.tif"):
        terrain = files.from_heightmap(tmp_path / name, 2.0, default_class="sand")
        np.testing.assert_array_equal(terrain.elevation[0], heights)
        assert (terrain.semantic == 8).all() and not terrain.friction.any()


def test_geotiff_without_its_extra_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(UserError, match=r'h.tif: .*pip install "vertiwm-jax\[geotiff\]"'):
        files.from_heightmap(tmp_path / "h.tif", 1.0)


def test_class_image_of_ids_or_colours(tmp_path):
    np.save(tmp_path / "h.npy", np.ones((21, 31)))
    ids = np.arange(6, dtype=np.uint8).reshape(2, 3) + 3
    Image.fromarray(ids).save(tmp_path / "ids.png")
    Image.fromarray(STANDARD.rgb[ids]).save(tmp_path / "rgb.png")
    Image.fromarray(STANDARD.rgb[ids]).convert("RGBA").save(tmp_path / "rgba.png")
    for name in ("ids.png", "rgb.png", "rgba.png"):
        terrain = files.from_heightmap(tmp_path / "h.npy", 1.0, class_image=tmp_path / name)
        np.testing.assert_array_equal(terrain.semantic[0], ids)


def test_a_bad_heightmap_is_named(tmp_path):
    np.save(tmp_path / "h.npy", np.ones((21, 31)))
    colours = STANDARD.rgb[np.full((2, 3), 4)]
    colours[1, 2] = (1, 2, 3)
    Image.fromarray(colours).save(tmp_path / "rgb.png")
    ids = np.full((2, 3), 4, np.uint8)
    ids[0, 1] = 77
    Image.fromarray(ids).save(tmp_path / "ids.png")
    (tmp_path / "broken.png").write_text("not a picture")
    for arguments, message in (
        ({"class_image": tmp_path / "rgb.png"}, r"rgb.png: .*found \(1, 2, 3\) at row 1, column 2"),
        (
            {"class_image": tmp_path / "ids.png"},
            r"ids.png: classes: .*found 77 .* row 0, column 1",
        ),
        ({"class_image": tmp_path / "broken.png"}, r"broken.png: class_image: expected a PNG"),
        ({"default_class": "lava"}, r"h.npy: classes: expected one of clay.* found 'lava'"),
        ({"height_range": (0, 4)}, r"h.npy: height_range: expected unsigned .* leave height_range"),
        ({"resolution": 0.0}, r"h.npy: resolution: .* found 0.0"),
        ({"path": tmp_path / "rgb.png"}, r"rgb.png: elevation: expected a 2-D array"),
        ({"path": tmp_path / "no.npy"}, r"no.npy: elevation: .*No such file"),
    ):
        with pytest.raises(MapError, match=message):
            files.from_heightmap(**({"path": tmp_path / "h.npy", "resolution": 1.0} | arguments))
