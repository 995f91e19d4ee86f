import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.classes import STANDARD
from vertiwm_jax.terrain.map import TerrainMap

MUD, CONCRETE = STANDARD.names.index("mud"), STANDARD.names.index("concrete")


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


surface_of = jax.jit(lambda terrain, world, xy: query.surface(terrain.select(world), xy))


def reference_surface(terrain, world, x, y):
    """One point at a time, in double precision, from the definition."""
    z, semantic = np.asarray(terrain.elevation[world], float), np.asarray(terrain.semantic[world])
    x0, y0 = np.asarray(terrain.origin, float)
    step = float(terrain.resolution)
    rows, columns = z.shape
    u = np.clip((x - x0) / step, 0, columns - 1)
    v = np.clip((y0 - y) / step, 0, rows - 1)
    c, r = min(int(u), columns - 2), min(int(v), rows - 2)
    i = min(int(v / (rows - 1) * semantic.shape[0]), semantic.shape[0] - 1)
    j = min(int(u / (columns - 1) * semantic.shape[1]), semantic.shape[1] - 1)
    kind = int(semantic[i, j])
    right, up = u - c, 1 - (v - r)
    tl, tr, bl, br = z[r, c], z[r, c + 1], z[r + 1, c], z[r + 1, c + 1]
    if STANDARD.deformable[kind]:
        height = (1 - up) * ((1 - right) * bl + right * br) + up * ((1 - right) * tl + right * tr)
    elif right > up:  # triangle bl, br, tr
        height = bl + right * (br - bl) + up * (tr - br)
    else:  # triangle bl, tr, tl
        height = bl + up * (tl - bl) + right * (tr - tl)
    return height, kind, float(terrain.friction[world, i, j])


def test_surface_equals_the_definition(terrain):
    rng = np.random.default_rng(1)
    # A few points lie off the map.
    xy = np.float32(rng.uniform((-8, -6), (14, 12), (4, 75, 2)))
    found = surface_of(terrain, 1, xy)
    expected = np.array([[reference_surface(terrain, 1, *p) for p in row] for row in xy])
    np.testing.assert_allclose(found.height, expected[..., 0], atol=2e-5)
    np.testing.assert_array_equal(found.semantic, expected[..., 1])
    np.testing.assert_allclose(found.friction, expected[..., 2])


def test_gradient_is_that_of_height_and_of_finite_differences(terrain):
    rng = np.random.default_rng(2)
    xy = np.float32(rng.uniform((-8, -6), (14, 12), (200, 2)))
    found = surface_of(terrain, 0, xy)
    automatic = jax.jit(jax.vmap(jax.grad(lambda p: query.surface(terrain, p).height)))(xy)
    np.testing.assert_allclose(found.gradient, automatic, atol=1e-5)
    step = 1e-4
    for axis, offset in enumerate(np.eye(2) * step):
        ahead, behind = (
            np.array([reference_surface(terrain, 0, *p) for p in xy + sign * offset])[:, 0]
            for sign in (1, -1)
        )
        near = np.abs((ahead - behind) / (2 * step) - found.gradient[:, axis]) < 1e-3
        assert near.mean() > 0.99  # the others straddle an edge


def test_soil_is_bilinear_and_rigid_ground_two_triangles():
    """One cell with its top right corner raised: 0.25 in the middle of soil, 0.5 on the split."""
    corner = np.array([[0.0, 1.0], [0.0, 0.0]])
    centre, lower = jnp.array([0.0, 0.0]), jnp.array([0.25, -0.25])
    for kind, middle, below in ((MUD, 0.25, 0.75 * 0.25), (CONCRETE, 0.5, 0.25)):
        terrain = TerrainMap.from_array(corner, np.array([[kind]]))
        assert surface_of(terrain, 0, centre).height == pytest.approx(middle)
        assert surface_of(terrain, 0, lower).height == pytest.approx(below)
        assert query.height(terrain, centre) == pytest.approx(0.25)
    # The other diagonal is no ridge of rigid ground: a raised top left corner leaves it flat.
    terrain = TerrainMap.from_array(corner[:, ::-1], np.array([[CONCRETE]]))
    assert surface_of(terrain, 0, centre).height == pytest.approx(0.0)


def test_nan_and_infinite_points_are_finite_with_finite_gradients(terrain):
    xy = jnp.array([[np.nan, 0.0], [0.0, np.nan], [np.inf, -np.inf]])
    found = surface_of(terrain, 0, xy)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    assert found.height[2] == terrain.elevation[0, -1, -1]
    slope = jax.vmap(jax.grad(lambda p: query.surface(terrain, p).height))(xy)
    assert np.isfinite(slope).all()
