import numpy as np
import pytest
import yaml
from PIL import Image

from vertiwm_jax.terrain import vertibench
from vertiwm_jax.terrain.classes import STANDARD
from vertiwm_jax.terrain.map import MapError
from vertiwm_jax.terrain.query import surface

DIFFICULTY = {"low": 4.8, "mid": 9.6, "high": 16.0}


def write_world(root, number, difficulty, gray, semantic):
    """A world in the layout of a checkout."""
    maps = root / "envs/data/BenchMaps/sampled_maps"
    (maps / "Worlds").mkdir(parents=True, exist_ok=True)
    (maps / "Configs/Final").mkdir(parents=True, exist_ok=True)
    Image.fromarray(gray).save(maps / f"Worlds/{number}.bmp")
    textures = []
    for (i, j), kind in np.ndenumerate(semantic):
        name = STANDARD.names[kind]
        patch = {"index": [i, j], "terrain_type": name, "center": {"x": 0.0, "y": 0.0}}
        if kind < 7:
            patch["friction"] = round(0.3 + 0.001 * (16 * i + j), 3)
        textures.append(patch)
    config = {
        "terrain": {"difficulty": difficulty, "max_height": DIFFICULTY[difficulty]},
        "terrain_type": "mixed",
        "textures": textures,
        "obstacles": {
            "rocks": [{"position": {"x": -20.0, "y": 35.0, "z": 1.7}, "scale": 0.5}],
            "trees": [{"position": {"x": 7.0, "y": -9.0, "z": 0.2}}],
        },
        "positions": [],
    }
    path = maps / f"Configs/Final/config{number}_{difficulty}.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


@pytest.fixture
def checkout(tmp_path):
    gray = np.zeros((129, 129), np.uint8)
    gray[10, 100] = 255  # x = 36, y = 54
    semantic = np.full((16, 16), 2)
    semantic[0, 15], semantic[3, 4] = 8, 1
    write_world(tmp_path, 91, "high", gray, semantic)
    write_world(tmp_path, 2, "low", gray, np.full((16, 16), 6))
    return tmp_path


def test_worlds_are_where_verti_bench_puts_them(checkout):
    terrain = vertibench.load(checkout)
    assert terrain.worlds == 2  # 2 before 91
    np.testing.assert_allclose(terrain.elevation.max((1, 2)), [4.8, 16], rtol=1e-6)
    points = np.array([[36.0, 54.0], [63.0, 63.0], [-30.0, 38.0]], np.float32)
    found = surface(terrain.select(np.int32(1)), points)
    np.testing.assert_allclose(found.height, [16, 0, 0], rtol=1e-6)
    assert [STANDARD.names[k] for k in found.semantic] == ["dirt", "sand", "concrete"]
    np.testing.assert_allclose(found.friction, [0.3 + 0.001 * (16 + 12), 0, 0.3 + 0.001 * 52])
    np.testing.assert_allclose(
        terrain.obstacles[1], [[-20, 35, 2.2, 2.2, 1.9], [7, -9, 1, 1, 5]], rtol=1e-6
    )


def test_what_is_wrong_with_a_checkout_is_named(checkout, tmp_path):
    with pytest.raises(MapError, match=r"folder: expected a checkout that holds envs/data"):
        vertibench.load(tmp_path / "envs")
    path = checkout / "envs/data/BenchMaps/sampled_maps/Configs/Final/config2_low.yaml"
    text = path.read_text()
    for old, new, message in (
        ("wood", "lava", r"file: expected Verti-Bench's YAML, found KeyError: 'lava'"),
        ("max_height", "height", r"file: .* KeyError: 'max_height'"),
        ("friction: 0.3\n", "f: 1\n", r"file: .* KeyError: 'friction'"),
        ("- 0\n  - 0\n", "- 0\n  - 1\n", r"classes: .* found -1 at row 0, column 0 \(1 such\)"),
        ("max_height: 4.8", "max_height: tall", r"file: .* ValueError: .*'tall'"),
        ("terrain:", "terrain: [", r"file: .* ParserError"),
    ):
        assert old in text
        path.write_text(text.replace(old, new, 1) if old != "wood" else text.replace(old, new))
        with pytest.raises(MapError, match=r"config2_low\.yaml: " + message):
            vertibench.load(checkout)
    path.write_text(text)
    Image.new("L", (64, 64)).save(checkout / vertibench._FOLDER / "Worlds/2.bmp")
    with pytest.raises(MapError, match=r"2.bmp: elevation: expected 129 x 129 pixels"):
        vertibench.load(checkout)
    (path.parents[2] / "Worlds/5.bmp").touch()
    with pytest.raises(MapError, match=r"world 5: expected one file config5_"):
        vertibench.load(checkout)
