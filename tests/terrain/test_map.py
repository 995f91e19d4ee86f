from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.classes import STANDARD
from vertiwm_jax.terrain.map import MapError, TerrainMap


def build(**changes):
    inputs = {"elevation": np.ones((17, 17)), "classes": np.full((4, 4), 3), "name": "my.npz"}
    return TerrainMap.from_array(**(inputs | changes))


def changed(array, where, value):
    array = np.array(array)
    array[where] = value
    return array


HEIGHTS, CLASSES = np.ones((17, 17)), np.full((4, 4), 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"elevation": changed(changed(HEIGHTS, (2, 5), np.nan), (9, 1), np.nan)},
            r"elevation: .* found nan at row 2, column 5 \(2 such\); fill the holes",
        ),
        ({"elevation": changed(HEIGHTS, (3, 4), -9999)}, r"elevation: .* found -9999.0 at .*holes"),
        ({"elevation": np.ones((17,))}, r"elevation: expected a 2-D array .*, found shape \(17,\)"),
        (
            {"elevation": np.ones((1, 17)), "classes": [[3]]},
            r"elevation: expected .* 2 x 2 vertices",
        ),
        ({"classes": changed(CLASSES, (1, 2), 10)}, r"classes: .*0 to 9 \(clay, .* found 10 at"),
        ({"classes": changed(CLASSES, (1, 2), -1)}, r"classes: .*found -1 at row 1"),
        ({"classes": np.full((4, 4), 0.5)}, r"classes: expected integer class ids"),
        ({"classes": np.full((4, 8), 3)}, r"classes: expected square cells .* 2.00 times"),
        (
            {"friction": np.full((4, 4), -0.5)},
            r"friction: expected numbers > 0 on rigid ground, found -0.5",
        ),
        (
            {"friction": np.full((4, 4), np.nan)},
            r"friction: expected numbers > 0 on rigid ground, found nan",
        ),
        ({"friction": np.zeros((4, 4))}, r"friction: .*> 0 on rigid ground, found 0.0"),
        ({"friction": np.ones((5, 4))}, r"friction: expected shape \(4, 4\), found \(5, 4\)"),
        ({"resolution": 0.0}, r"resolution: .*> 0, found 0.0"),
        ({"resolution": -1.0}, r"resolution: .*> 0, found -1.0"),
        ({"origin": (np.nan, 0)}, r"origin: expected finite x, y"),
        ({"obstacles": [[99, 0, 1, 1, 1]]}, r"obstacles: expected centers within x -8 to 8"),
        ({"obstacles": [[0, 0, -1, 1, 1]]}, r"obstacles: expected sizes and heights >= 0"),
        ({"obstacles": [[0, 0, 1, 1]]}, r"obstacles: expected shape \(any, 5\)"),
    ],
)
def test_each_defect_is_named(changes, message):
    with pytest.raises(MapError, match="^my.npz: " + message):
        build(**changes)


def test_a_soil_out_of_range_is_named():
    soils = {**STANDARD.soils, "mud": STANDARD.soils["mud"].replace(n=np.float32(40))}
    with pytest.raises(MapError, match=r"my.npz: soils: .*found n of 40, outside 0.05 to 3"):
        build(ground=replace(STANDARD, soils=soils))


def test_a_palette_has_a_color_for_each_class():
    with pytest.raises(MapError, match=r"my.npz: class_rgb: expected shape \(10, 3\)"):
        build(ground=replace(STANDARD, rgb=STANDARD.rgb[:9]))


def test_friction_is_the_mean_of_the_class_unless_given():
    semantic = np.arange(16).reshape(4, 4) % 10
    terrain = build(classes=semantic)
    np.testing.assert_allclose(terrain.friction[0], STANDARD.friction[semantic])
    given = build(classes=semantic, friction=np.where(semantic < 7, 0.25, np.nan))
    np.testing.assert_allclose(given.friction[0], np.where(semantic < 7, 0.25, 0))


def test_a_map_is_centred_unless_told():
    terrain = build(elevation=np.ones((9, 17)), classes=np.zeros((2, 4), int), resolution=0.5)
    np.testing.assert_allclose(terrain.origin, [-4, 2])
    np.testing.assert_allclose(terrain.size, [8, 4])
    np.testing.assert_allclose(terrain.extent, [[-4, -2], [4, 2]])


def test_a_map_of_an_array_may_be_oblong_and_high_above_the_sea():
    heights = 312 + np.add.outer(np.zeros(9), np.arange(17.0))
    terrain = TerrainMap.from_array(heights, "sand", resolution=0.5, origin=(100.0, 50.0))
    np.testing.assert_allclose(terrain.extent, [[100, 46], [108, 50]])
    found = query.surface(terrain, jnp.array([101.0, 49.0]))
    assert float(found.height) == 314 and terrain.class_names[int(found.semantic)] == "sand"
    state = place(terrain)
    np.testing.assert_allclose(state.position[:2], [104, 48])
    assert 320 < float(state.position[2]) < 321 and float(state.rpy[1]) < -1
    with pytest.raises(MapError, match=r"^map: classes: expected one of clay, .* found 'lava'"):
        TerrainMap.from_array(heights, "lava")


UTM = 512345.25, 5234567.5


def test_positions_on_a_far_map_are_counted_from_its_middle():
    x, y = UTM
    box = [x + 3.25, y - 12.5, 1, 2, 3]
    far = build(origin=UTM, obstacles=[box, np.zeros(5)])
    near = build(origin=(-8, 8), obstacles=[[-4.75, -4.5, 1, 2, 3], np.zeros(5)])
    jax.tree.map(np.testing.assert_array_equal, jax.tree.leaves(far), jax.tree.leaves(near))
    assert far.offset().tolist() == [x + 8, y - 8] and near.offset().tolist() == [0, 0]
    assert near.offset(np.zeros((2, 3), int)).shape == (2, 3, 2)
    # Nothing that is traced sees it.
    add_up = str(jax.make_jaxpr(lambda terrain: query.height(terrain, jnp.zeros(2)))(far))
    assert add_up == str(jax.make_jaxpr(lambda terrain: query.height(terrain, jnp.zeros(2)))(near))
    with pytest.raises(MapError, match=r"obstacles: expected centers within x 512345.25 to"):
        build(origin=UTM, obstacles=[[0, 0, 1, 1, 1]])


def test_a_map_is_far_where_float32_does_not_resolve_it():
    for origin in ((900.0, -900.0), (-1000.0, 8.0)):
        assert not build(origin=origin).middles and build(origin=origin).origin[0] == origin[0]
    assert build(origin=(1000.0, 8.0)).middles == ((1008.0, 0.0),)


def test_far_worlds_of_several_places_are_stacked():
    home, away = build(origin=UTM), build(origin=(UTM[0] + 100, UTM[1]))
    centered = build(elevation=np.zeros((17, 17)))
    stacked = terrain_map.stack([home, terrain_map.stack([centered, away])])
    middle = np.array(UTM) + [8, -8]
    expected = [middle, np.zeros(2), middle + [100, 0]]
    np.testing.assert_array_equal(stacked.offset(np.arange(3)), expected)
    np.testing.assert_array_equal(stacked.select(jnp.int32(2)).offset(), expected[2])
    np.testing.assert_array_equal(stacked.subset(np.array([2, 1])).offset([0, 1]), expected[:0:-1])
    some = stacked.subset(np.array([True, False, True]))
    np.testing.assert_array_equal(some.offset([0, 1]), expected[::2])


def test_stack_joins_worlds_and_pads_obstacles():
    first = build(elevation=np.zeros((17, 17)))
    second = build(obstacles=[[1, 2, 3, 4, 5]])
    both = terrain_map.stack([terrain_map.stack([first, second]), first])
    assert both.worlds == 3 and both.obstacles.shape == (3, 1, 5)
    np.testing.assert_array_equal(both.elevation[:, 0, 0], [0, 1, 0])
    np.testing.assert_array_equal(both.obstacles[:, 0, 2], [0, 3, 0])


def test_every_world_may_have_soils_of_its_own():
    one = build()
    firm = one.with_soils(replace(query.soils(one), kphi=2 * query.soils(one).kphi))
    assert len(terrain_map.stack([one, one]).soils.n) == 1
    both = terrain_map.stack([one, terrain_map.stack([firm, one])])
    sand = STANDARD.names.index("sand")
    found = jax.vmap(lambda i: query.soil(both.select(i), jnp.int32(sand)).kphi)(jnp.arange(3))
    np.testing.assert_array_equal(found / found[0], [1, 2, 1])
    kept = both.subset(np.array([2, 1]))
    assert kept.worlds == 2 and query.soils(kept.select(jnp.int32(1))).kphi[sand] == found[1]
    everywhere = kept.with_soils(query.soils(firm)).select(jnp.int32(0))
    assert query.soils(everywhere).kphi[sand] == found[1]


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"elevation": np.ones((33, 33))}, "elevation"),
        ({"classes": np.full((8, 8), 3)}, "semantic"),
        ({"resolution": 2.0}, "origin"),
        ({"resolution": 2.0, "origin": (-8, 8)}, "resolution"),
    ],
)
def test_stack_names_what_differs(changes, field):
    with pytest.raises(MapError, match=f"^b.npz: {field}: expected .* as in a.npz"):
        terrain_map.stack([build(), build(**changes)], ["a.npz", "b.npz"])


def test_stack_of_nothing():
    with pytest.raises(MapError, match="at least one map"):
        terrain_map.stack([])
