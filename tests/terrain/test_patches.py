from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain import patches
from vertiwm_jax.terrain.classes import STANDARD
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.ruts import Ruts

CONCRETE, GRASS = STANDARD.names.index("concrete"), STANDARD.names.index("grass")


@pytest.fixture(scope="module")
def terrain():
    """Three rough worlds of 33 x 41 vertices at 0.5 m, off-centre, with 2 m cells of any class."""
    rng = np.random.default_rng(0)
    return terrain_map.stack(
        [
            TerrainMap.from_array(
                rng.uniform(0, 3, (33, 41)),
                rng.integers(0, 10, (8, 10)),
                resolution=0.5,
                origin=(-7.0, 11.0),
            )
            for _ in range(3)
        ]
    )


@jax.jit
def patches_of(terrain, world, position, yaw):
    return patches.query(terrain.select(world), position, yaw)


def bilinear(z, u, v):
    """Heights between the four vertices around column u, row v, in double precision."""
    c = np.minimum(np.asarray(u).astype(int), z.shape[1] - 2)
    r = np.minimum(np.asarray(v).astype(int), z.shape[0] - 2)
    f, g = u - c, v - r
    top, bottom = (z[i, c] * (1 - f) + z[i, c + 1] * f for i in (r, r + 1))
    return top * (1 - g) + bottom * g


def reference_patches(terrain, world, x, y, height, yaw):
    z, semantic = np.asarray(terrain.elevation[world], float), np.asarray(terrain.semantic[world])
    x0, y0 = np.asarray(terrain.origin, float)
    step = float(terrain.resolution)
    elevation, rgb = np.zeros((128, 128)), np.zeros((128, 128, 3))
    for row in range(128):
        for column in range(128):
            ahead, left = 6.35 - 0.1 * row, 6.35 - 0.1 * column
            px = x + np.cos(yaw) * ahead - np.sin(yaw) * left
            py = y + np.sin(yaw) * ahead + np.cos(yaw) * left
            u = np.clip((px - x0) / step, 0, z.shape[1] - 1)
            v = np.clip((y0 - py) / step, 0, z.shape[0] - 1)
            elevation[row, column] = (bilinear(z, u, v) - height) / 4
            i = min(int(v / (z.shape[0] - 1) * semantic.shape[0]), semantic.shape[0] - 1)
            j = min(int(u / (z.shape[1] - 1) * semantic.shape[1]), semantic.shape[1] - 1)
            rgb[row, column] = STANDARD.rgb[semantic[i, j]] / 255.0 * 2 - 1
    return elevation, rgb


@pytest.mark.parametrize("pose", [(1.3, 2.7, 0.6), (-6.0, 10.0, -2.2)])
def test_patches_equal_a_plain_loop(terrain, pose):
    x, y, yaw = pose
    found = patches_of(terrain, 1, jnp.array([x, y, 0.7]), jnp.float32(yaw))
    elevation, rgb = reference_patches(terrain, 1, x, y, 0.7, yaw)
    np.testing.assert_allclose(found.elevation, elevation, atol=1e-5)
    # Pixels on a rounding border may fall either way in float32.
    assert np.mean(np.abs(found.rgb - rgb).max(-1) > 1e-5) < 1e-3


@pytest.mark.parametrize("eighth", range(8))
def test_patches_show_bump_and_colour_where_they_are(eighth):
    """A bump 4 m ahead and a patch of concrete 4 m to the left, placed by heading."""
    yaw = eighth * np.pi / 4
    vehicle = np.array([3.0, -5.0])
    forward, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    axis = np.arange(129) * 0.25 - 16
    x, y = axis[None, :], -axis[:, None]
    bump, spot = vehicle + 4 * forward, vehicle + 4 * left
    elevation = 4 * np.exp(-((x - bump[0]) ** 2 + (y - bump[1]) ** 2))
    cell = np.arange(128) * 0.25 - 15.875
    near = np.hypot(cell[None, :] - spot[0], -cell[:, None] - spot[1]) < 0.8
    terrain = TerrainMap.from_array(elevation, np.where(near, CONCRETE, GRASS), resolution=0.25)

    position = jnp.array([*vehicle, 0.0], jnp.float32)
    found = patches_of(terrain, 0, position, jnp.float32(yaw))
    row, column = np.unravel_index(np.argmax(found.elevation), (128, 128))
    assert abs(row - 23.5) <= 2 and abs(column - 63.5) <= 2
    coloured = np.argwhere(np.asarray(found.rgb)[..., 2] > 0)  # concrete alone is bluish
    np.testing.assert_allclose(coloured.mean(0), [63.5, 23.5], atol=1.5)
    assert len(coloured) == pytest.approx(np.pi * 8**2, rel=0.1)


def test_patches_are_bounded_and_batch_over_worlds(terrain):
    position = jnp.array([[0.0, 0.0, 0.0], [100.0, -100.0, 0.0], [-1e9, 3.0, 0.0]])
    axes = (None, 0, 0, 0)
    batched = jax.jit(jax.vmap(lambda t, w, p, a: patches.query(t.select(w), p, a), axes))
    found = batched(terrain, jnp.array([0, 1, 2]), position, jnp.zeros(3))
    assert found.elevation.shape == (3, 128, 128) and found.rgb.shape == (3, 128, 128, 3)
    for world in range(3):
        alone = patches_of(terrain, world, position[world], jnp.float32(0))
        np.testing.assert_array_equal(found.elevation[world], alone.elevation)
        np.testing.assert_array_equal(found.rgb[world], alone.rgb)
    # Far off the map, every pixel is its nearest corner.
    np.testing.assert_allclose(found.elevation[1], terrain.elevation[1, -1, -1] / 4, atol=1e-6)
    assert np.abs(found.elevation).max() <= 1 and np.abs(found.rgb).max() <= 1


@pytest.mark.parametrize("resolution", [0.5, 1.0])
@pytest.mark.parametrize("pose", [(np.nan, np.nan, 0.0), (0.0, 0.0, np.nan)])
def test_nan_pose_sees_the_first_vertex(terrain, pose, resolution):
    terrain = replace(terrain, resolution=jnp.float32(resolution))
    found = patches_of(terrain, 2, jnp.array([*pose[:2], 0.0]), jnp.float32(pose[2]))
    np.testing.assert_allclose(found.elevation, terrain.elevation[2, 0, 0] / 4, atol=1e-6)
    assert np.isfinite(found.rgb).all()


def test_no_gradient_flows_from_patches_to_the_pose(terrain):
    def total(position, yaw):
        found = patches.query(terrain, position, yaw)
        return found.elevation.sum() + found.rgb.sum()

    slopes = jax.grad(total, (0, 1))(jnp.array([1.0, 2.0, 1.5]), jnp.float32(0.3))
    assert not any(np.any(slope) for slope in slopes)


@pytest.mark.parametrize("resolution, vertices_a_class", [(1.3, 4), (0.98, 4), (1.0, 2 / 3)])
@pytest.mark.parametrize(
    "pose",
    [
        (2.3, 1.7, 1.25, -0.8),
        (0.13, 0.04, 2.0, np.pi / 4),
        (-7.0, 11.0, 1.0, 2.0),
        (60, -90, 1.0, 3),
    ],
)
def test_bilinear_patches_relative_to_the_vehicle(resolution, vertices_a_class, pose):
    """Near and beyond the edge, at any heading."""
    rng = np.random.default_rng(1)
    heights = rng.uniform(0, 3, (25, 33))
    kinds = rng.integers(0, 10, (int(24 / vertices_a_class), int(32 / vertices_a_class)))
    terrain = TerrainMap.from_array(heights, kinds, resolution=resolution, origin=(-7.0, 11.0))

    x, y, z, yaw = pose
    found = patches_of(terrain, 0, jnp.array([x, y, z]), jnp.float32(yaw))
    place = 6.35 - 0.1 * np.arange(128)
    ahead, left = place[:, None], place[None, :]
    px = x + np.cos(yaw) * ahead - np.sin(yaw) * left
    py = y + np.sin(yaw) * ahead + np.cos(yaw) * left
    u, v = np.clip((px + 7) / resolution, 0, 32), np.clip((11 - py) / resolution, 0, 24)
    expected = (bilinear(np.asarray(terrain.elevation[0], float), u, v) - z) / 4
    np.testing.assert_allclose(found.elevation, expected, atol=1e-5)
    i, j = (
        np.minimum((w / vertices_a_class).astype(int), most - 1)
        for w, most in zip((v, u), kinds.shape, strict=True)
    )
    # Pixels on a rounding border may fall either way in float32.
    colours = STANDARD.rgb[kinds[i, j]] / 255.0 * 2 - 1
    assert np.mean(np.abs(found.rgb - colours).max(-1) > 1e-5) < 1e-3


def test_patches_of_the_smallest_map():
    terrain = TerrainMap.from_array(np.array([[0.0, 1.0], [2.0, 3.0]]), np.array([[CONCRETE]]))
    found = patches_of(terrain, 0, jnp.zeros(3), jnp.float32(0))
    corners = found.elevation[jnp.array([0, 0, -1, -1]), jnp.array([0, -1, 0, -1])]
    np.testing.assert_allclose(4 * corners, [1, 3, 0, 2], atol=1e-6)  # ahead is to the right


def test_ground_far_above_or_below_the_vehicle_is_cut_off(terrain):
    for height, expected in ((30.0, -1), (-30.0, 1)):
        found = patches_of(terrain, 0, jnp.array([0.0, 0.0, height]), 0.0)
        np.testing.assert_array_equal(found.elevation, expected)


def test_footprint_must_fit_the_patch():
    patches.footprint_covered(2.4, 8.0)
    with pytest.raises(ValueError, match=r"12.8 m .* found .*6\.9 m > 6\.4 m; keep the top speed"):
        patches.footprint_covered(2.4, 45.0)
    with pytest.raises(ValueError, match="patch"):
        patches.footprint_covered(float("nan"), 4.0)


def test_ruts_are_as_deep_as_they_were_pressed(terrain):
    """Pixels lie in the middles of the cells of ruts, of which one in two is pressed."""
    position = jnp.array([1.3, 2.7, 0.6])
    offset = 6.35 - 0.1 * jnp.arange(128)
    x, y = jnp.meshgrid(1.3 + offset, 2.7 + offset, indexing="ij")
    pressed = jnp.arange(128 * 128).reshape(128, 128) % 2 == 0
    depth = jnp.where(pressed, 0.2 + 0.1 * jnp.sin(x) * jnp.cos(y), 0.0)
    xy = jnp.stack([x, y], axis=-1).reshape(-1, 2)
    ruts = Ruts.none(position).pressed(xy, depth.ravel())
    whole = patches_of(terrain, 1, position, 0.0).elevation
    rutted = patches_of(replace(terrain, ruts=ruts), 1, position, 0.0).elevation
    np.testing.assert_allclose(whole - rutted, depth / 4, atol=2e-6)
