import jax
import numpy as np
import pytest

from vertiwm_jax.terrain import worlds
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.worlds import WorldConfig

CONFIG = WorldConfig(("low", "mid", "high", "extreme"), rocks=20, trees=2)
COUNT = 24


@pytest.fixture(scope="module")
def terrain():
    return worlds.generate(jax.random.split(jax.random.key(0), COUNT), CONFIG)


def slopes(z):
    """Slopes in degrees of all triangles, split from bottom left to top right, of 1 m cells."""
    tl, tr, bl, br = z[:-1, :-1], z[:-1, 1:], z[1:, :-1], z[1:, 1:]
    lower, upper = np.hypot(br - bl, tr - br), np.hypot(tl - bl, tr - tl)
    return np.degrees(np.arctan(np.stack([lower, upper])))


def of_difficulty(terrain, name):
    drawn = worlds.labels(CONFIG, COUNT)
    return [np.asarray(terrain.elevation[w]) for w in range(COUNT) if drawn[w][0] == name]


@pytest.mark.parametrize(("name", "median"), [("low", 5.8), ("mid", 11.3), ("high", 18.5)])
def test_median_slope_is_that_of_verti_bench(terrain, name, median):
    found = [np.median(slopes(z)) for z in of_difficulty(terrain, name)]
    assert np.mean(found) == pytest.approx(median, rel=0.07)
    assert np.max(np.abs(np.array(found) / median - 1)) < 0.15


def test_high_worlds_are_as_hard_as_verti_bench(terrain):
    """Its 33 high worlds: slopes of 36 and 56 deg at the 90th and 99th percentile."""
    tail = np.mean([np.percentile(slopes(z), [90, 99]) for z in of_difficulty(terrain, "high")], 0)
    np.testing.assert_allclose(tail, [36.0, 56.1], rtol=0.1)
    steps = [np.abs(np.diff(z, axis=1)) for z in of_difficulty(terrain, "high")]
    assert np.percentile(steps, 99) > 0.9


def test_roughness_spreads_over_the_octaves_as_in_verti_bench(terrain):
    """Its share of power from 16 to 2 m wavelength is 0.63, of which 0.11 below 4 m."""
    shares = []
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(129), np.fft.fftfreq(129)))
    window = np.hanning(129)
    for z in of_difficulty(terrain, "high"):
        power = np.abs(np.fft.fft2((z - z.mean()) * window * window[:, None])) ** 2
        bands = [
            power[(frequency >= a) & (frequency < 2 * a)].sum() for a in 2.0 ** -np.arange(2, 7)
        ]
        shares.append(np.array(bands) / np.sum(bands))
    finest, fine, middle = np.median(shares, 0)[:3]
    assert 0.03 < finest < 0.2 and fine > 0.1 and 0.3 < finest + fine + middle < 0.85


def test_generated_maps_are_valid_and_leave_no_range(terrain):
    arrays = (terrain.elevation, terrain.semantic, terrain.friction, terrain.obstacles)
    for heights, classes, friction, boxes in zip(*map(np.asarray, arrays), strict=True):
        TerrainMap.from_array(heights, classes, friction=friction, obstacles=boxes)
    assert terrain.worlds == COUNT and terrain.elevation.shape == (COUNT, 129, 129)
    np.testing.assert_allclose(terrain.elevation.min((1, 2)), 0, atol=1e-6)


def test_kinds(terrain):
    for (_, kind), semantic in zip(
        worlds.labels(CONFIG, COUNT), np.asarray(terrain.semantic), strict=True
    ):
        share = np.mean(semantic >= 7)
        low, high = {"rigid": (0, 0), "deformable": (1, 1), "mixed": (0.035, 0.8)}[kind]
        assert low <= share <= high, kind
    assert len(np.unique(terrain.semantic)) == 10


def test_friction_follows_the_classes(terrain):
    semantic, friction = np.asarray(terrain.semantic), np.asarray(terrain.friction)
    assert not friction[semantic >= 7].any()
    grass, concrete = friction[semantic == 3], friction[semantic == 1]
    assert grass.mean() == pytest.approx(0.36, abs=0.02) and 0.05 < grass.std() < 0.09
    assert concrete.mean() == pytest.approx(0.85, abs=0.03) and concrete.max() <= 1


def test_obstacles_leave_starts_and_goals_free(terrain):
    boxes = np.asarray(terrain.obstacles)
    assert boxes.shape == (COUNT, 22, 5)
    corner = np.abs(boxes[..., :2]) + boxes[..., 2:4] / 2
    assert corner.max() <= 64
    nearest = np.hypot(
        *np.moveaxis(np.maximum(np.abs(boxes[..., :2]) - boxes[..., 2:4] / 2, 0), -1, 0)
    )
    farthest = np.hypot(*np.moveaxis(corner, -1, 0))
    assert ((farthest <= 54) | (nearest >= 66)).all()
    assert (boxes[:, :20, 4] <= 4.56).all() and (boxes[:, 20:, 4] == 5).all()


def test_a_seed_is_a_world(terrain):
    keys = jax.random.split(jax.random.key(0), COUNT)
    again = worlds.generate(keys, CONFIG)
    for a, b in zip(jax.tree.leaves(terrain), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert len({z.tobytes() for z in np.asarray(terrain.elevation)}) == COUNT


def test_level_ground_without_anything_on_it():
    config = WorldConfig((0.0,), ("mixed",))
    terrain = worlds.generate(jax.random.split(jax.random.key(1), 1), config)
    assert not np.any(terrain.elevation) and terrain.obstacles.shape == (1, 0, 5)


def test_labels_cycle_through_all_pairs():
    config = WorldConfig(("low", 30.0), ("rigid", "mixed"))
    assert worlds.labels(config, 5) == [
        ("low", "rigid"), (30.0, "rigid"), ("low", "mixed"), (30.0, "mixed"), ("low", "rigid"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"difficulties": ("hard",)}, "difficulties: expected .* one of low, mid, high, extreme"),
        ({"difficulties": (75.0,)}, "a median slope of 0 to 60 deg, .*, found .75"),
        ({"kinds": ("ice",)}, "kinds: expected one of rigid, deformable, mixed, found .'ice'"),
        ({"kinds": ()}, "found none"),
    ],
)
def test_unknown_settings_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        WorldConfig(**arguments)
