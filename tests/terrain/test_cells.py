import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.networks.encoder import in_rows
from vertiwm_jax.terrain import cells, patches
from vertiwm_jax.terrain import map as terrain_map

COARSE, AS_COARSE_AS_CLASSES, FINE, FINE_CLASSES = (1.3, 4), (1.0, 1), (0.98, 4), (1.0, 2 / 3)
POSES = [
    (2.3, 1.7, 1.25, -0.8),
    (0.13, 0.04, 2.0, np.pi / 4),
    (-7.0, 11.0, 1.0, 2.0),
    (60, -90, 1.0, 3),
    (np.nan, 0.0, 1.0, 0.2),
]


def world(resolution: float, vertices_a_class: float, classes: int = 10, seed: int = 1):
    """25 x 33 vertices, with cells of any of the first classes."""
    rng = np.random.default_rng(seed)
    heights = rng.uniform(0, 3, (25, 33))
    kinds = rng.integers(0, classes, (int(24 / vertices_a_class), int(32 / vertices_a_class)))
    return terrain_map.build(heights, kinds, resolution=resolution, origin=(-7.0, 11.0))


def kernels(outputs: int = 5):
    """Of elevation `[64, F]` and of colours `[3, 64, F]`."""
    of_both = jax.random.normal(jax.random.key(0), (4, 64, outputs)) / 8
    return of_both[0], of_both[1:]


@jax.jit
def projected(terrain, position, yaw, of_both):
    found = cells.projections(terrain, position, yaw, *of_both)
    return tuple(in_rows(x) for x in found)


@jax.jit
def of_patches(terrain, position, yaw, of_both):
    """The same of all pixels, one cell after the other."""
    seen = patches.query(terrain, position, yaw)
    squares = seen.elevation.reshape(16, 8, 16, 8), seen.rgb.reshape(16, 8, 16, 8, 3)
    of_elevation, of_colours = (k.reshape(*k.shape[:-2], 8, 8, -1) for k in of_both)
    return (
        jnp.einsum("aibj,ijf->abf", squares[0], of_elevation, precision="highest"),
        jnp.einsum("aibjc,cijf->abf", squares[1], of_colours, precision="highest"),
    )


def same(found, expected, share=0.01):
    """To rounding, but for cells with a pixel on a border, which may fall either way in float32."""
    np.testing.assert_allclose(found[0], expected[0], atol=1e-5)
    assert np.mean(np.abs(found[1] - expected[1]).max(-1) > 1e-5) <= share


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize(
    "resolution, vertices_a_class", [COARSE, AS_COARSE_AS_CLASSES, FINE, FINE_CLASSES]
)
def test_projections_are_those_of_all_pixels(resolution, vertices_a_class, pose):
    """Read by cells or by pixels, near and beyond the edge, at any heading."""
    terrain = world(resolution, vertices_a_class)
    coarse = (resolution, vertices_a_class) in (COARSE, AS_COARSE_AS_CLASSES)
    assert cells._is_coarse(terrain) == coarse
    at = jnp.array(pose[:3]), jnp.float32(pose[3])
    same(projected(terrain, *at, kernels()), of_patches(terrain, *at, kernels()))


@pytest.mark.parametrize("classes", [1, 10])  # no cell has a border in it, or most have
@pytest.mark.parametrize("vehicles", [(5,), (2, 3)])
def test_batches_are_those_of_one_at_a_time(vehicles, classes):
    """Cells with borders are drawn together, of whichever vehicle they are."""
    worlds = [world(1.0, 1, classes, seed) for seed in range(3)]
    terrain, number = terrain_map.stack(worlds), int(np.prod(vehicles))
    rng = np.random.default_rng(2)
    position = jnp.asarray(rng.uniform((-7, -12, 0), (24, 11, 3), (number, 3)), jnp.float32)
    yaw = jnp.asarray(rng.uniform(-3, 3, number), jnp.float32)
    which = jnp.arange(number) % 3

    def one(which, position, yaw):
        return projected(terrain.select(which), position, yaw, kernels())

    many = one
    for _ in vehicles:
        many = jax.vmap(many)
    of_all = (x.reshape(*vehicles, *x.shape[1:]) for x in (which, position, yaw))
    found = [x.reshape(number, *x.shape[len(vehicles) :]) for x in jax.jit(many)(*of_all)]
    for i in range(number):
        alone = of_patches(terrain.select(which[i]), position[i], yaw[i], kernels())
        same([x[i] for x in found], alone, share=0.02)
        assert np.ptp(found[1][i], axis=(0, 1)).max() > 0 or classes == 1


def test_a_batch_of_linear_maps():
    """As of several models side by side."""
    terrain, position, yaw = world(1.0, 1), jnp.array([2.3, 1.7, 1.0]), jnp.float32(0.4)
    both = jax.tree.map(lambda x: jnp.stack([x, -2 * x]), kernels())
    found = jax.vmap(lambda k: projected(terrain, position, yaw, k))(both)
    for i, factor in enumerate((1, -2)):
        alone = projected(terrain, position, yaw, kernels())
        for x, y in zip(found, alone, strict=True):
            np.testing.assert_allclose(x[i], factor * y, atol=1e-5)


def test_no_gradient_flows():
    def total(position, yaw, of_both):
        return sum(x.sum() for x in projected(world(1.0, 4), position, yaw, of_both))

    slopes = jax.grad(total, (0, 1, 2))(jnp.array([1.0, 2.0, 1.5]), jnp.float32(0.3), kernels())
    assert not any(np.any(slope) for slope in jax.tree.leaves(slopes))
