"""What `perceive` gives on CPUs is what plain patches and encoders give."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from world_model.examples import driving, one, rough

from vertiwm_jax.networks.encoder import TerrainEncoder
from vertiwm_jax.perception import _fast
from vertiwm_jax.perception.features import Encoders, init_pair, init_reduce, init_soil
from vertiwm_jax.perception.perceive import _plain, perceive, reduced
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain import patches, sensing
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.ruts import Ruts
from vertiwm_jax.terrain.sensing import SensingConfig

CHANNELS = 5
COARSE, AS_COARSE_AS_CLASSES, FINE, FINE_CLASSES = (1.3, 4), (1.0, 1), (0.98, 4), (1.0, 2 / 3)
POSES = [
    (2.3, 1.7, 1.25, -0.8),
    (0.13, 0.04, 2.0, np.pi / 4),
    (-7.0, 11.0, 1.0, 2.0),
    (60, -90, 1.0, 3),
    (np.nan, 0.0, 1.0, 0.2),
]


def filled(tree):
    """No weight is zero."""
    return jax.tree.map(lambda x: x + 0.03 * jnp.cos(jnp.arange(x.size)).reshape(x.shape), tree)


def encoders(seed: int, **more) -> Encoders:
    return filled(replace(init_pair(jax.random.key(seed)), **more))


FIRST = encoders(0, reduce=init_reduce(jax.random.key(1), CHANNELS))
SECOND = encoders(2, soil=init_soil(jax.random.key(3)))
SHARED = replace(FIRST, soil=SECOND.soil)
PAIRS = {"shared": (SHARED,), "own": (FIRST, SECOND), "only encoders": (encoders(4),)}


def world(resolution=1.0, vertices_a_class=1.0, classes=10, seed=1) -> terrain_map.TerrainMap:
    """25 x 33 vertices, with cells of any of the first classes."""
    rng = np.random.default_rng(seed)
    heights = rng.uniform(0, 3, (25, 33))
    kinds = rng.integers(0, classes, (int(24 / vertices_a_class), int(32 / vertices_a_class)))
    return TerrainMap.from_array(heights, kinds, resolution=resolution, origin=(-7.0, 11.0))


def at(x, y, z, yaw) -> VehicleState:
    still = jnp.zeros(3)
    place = jnp.array([x, y, z], jnp.float32)
    return VehicleState(place, still.at[2].set(yaw), still, still)


def places(*batch: int, seed: int = 2) -> VehicleState:
    """Anywhere on `world` and about its edge."""
    rng = np.random.default_rng(seed)
    low, high = (-9, -15, 0, -3), (27, 13, 3, 3)
    x, y, z, yaw = jnp.asarray(np.moveaxis(rng.uniform(low, high, (*batch, 4)), -1, 0), jnp.float32)
    still = jnp.zeros((*batch, 3))
    return VehicleState(jnp.stack([x, y, z], -1), still.at[..., 2].set(yaw), still, still)


def look(pairs, terrain, state, latents=False):
    return reduced(pairs, perceive(pairs, terrain, state, latents))


perceived = jax.jit(look, static_argnames="latents")
plain = jax.jit(_plain, static_argnames="latents")


def same(found, expected, share=0.01):
    """To rounding, but for cells with a pixel on a border, which may fall either way in float32."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for x, y in zip(found, expected, strict=True):
        np.testing.assert_allclose(x.average, y.average, atol=2e-3)
        if y.reduced is not None:
            cells = np.abs(x.reduced - y.reduced).reshape(-1, CHANNELS).max(-1)
            assert np.mean(cells > 1e-4) <= share
        if y.latents is not None:
            elevation, colors = np.split(np.abs(x.latents - y.latents).reshape(-1, 36), 2, axis=-1)
            assert elevation.max() <= 1e-4 and np.mean(colors.max(-1) > 1e-4) <= share
        if y.soil is not None:
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3), x.soil, y.soil)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("kind", [COARSE, AS_COARSE_AS_CLASSES, FINE, FINE_CLASSES])
def test_near_and_beyond_the_edge_of_coarse_and_fine_maps(kind, pose):
    terrain = world(*kind)
    assert _fast._is_coarse(terrain) == (kind in (COARSE, AS_COARSE_AS_CLASSES))
    given = PAIRS["shared"], terrain, at(*pose)
    same(perceived(*given, latents=True), plain(*given, latents=True))


@pytest.mark.parametrize("latents", [False, True])
@pytest.mark.parametrize("pairs", PAIRS)
@pytest.mark.parametrize("batch", [(1,), (5,), (37,), (2, 3)])
@pytest.mark.integration
def test_batches_are_those_of_one_at_a_time(batch, pairs, latents):
    """Vehicles look in turns, and cells with borders are drawn together."""
    terrain = terrain_map.stack([world(seed=seed) for seed in range(3)])
    number, states = int(np.prod(batch)), places(*batch)
    which = (jnp.arange(number) % 3).reshape(batch)

    def of_all(look):
        def many(which, state):
            return look(PAIRS[pairs], terrain.select(which), state, latents=latents)

        for _ in batch:
            many = jax.vmap(many)
        return jax.tree.map(
            lambda x: x.reshape(number, *x.shape[len(batch) :]), jax.jit(many)(which, states)
        )

    found, expected = of_all(look), of_all(_plain)
    for i in range(number):
        same(one(found, i), one(expected, i), share=0.02)
    assert (found[0].latents is not None) == latents
    assert all(other.latents is None for other in found[1:])


def test_weights_may_be_constants_of_a_program():
    terrain, states = world(), places(40)

    def of_all(pairs):
        return jax.vmap(lambda state: look(pairs, terrain, state))(states)

    expected = jax.jit(of_all)(PAIRS["own"])
    same(jax.jit(lambda: of_all(PAIRS["own"]))(), expected)


@pytest.mark.parametrize("classes", [1, 10])  # no cell has a border in it, or most have
def test_cells_of_one_color_and_cells_with_borders(classes):
    given = PAIRS["own"], world(classes=classes), places()
    same(perceived(*given), plain(*given))


def test_a_map_of_which_a_part_is_known():
    config, terrain, states = SensingConfig(range=4.0), world(), places(3)

    def of_all(look):
        def seen(state):
            pose = state.position, state.rpy[2]
            known = replace(terrain, observed=sensing.look(config, terrain, *pose))
            return look(PAIRS["shared"], known, state)

        return jax.jit(jax.vmap(seen))(states)

    found, expected = of_all(perceive), of_all(_plain)
    for i in range(3):
        same(one(found, i), one(expected, i), share=0.02)
    other = jax.vmap(lambda state: perceive(PAIRS["shared"], terrain, state))(states)
    assert np.abs(other[0].average - found[0].average).max() > 0.1


@pytest.mark.integration
def test_several_models_and_several_maps():
    states = places(2)
    models = jax.tree.map(lambda x: jnp.stack([x, 1.3 * x]), PAIRS["own"])
    maps = jax.tree.map(lambda *x: jnp.stack(x), world(seed=1), world(seed=2))
    for axes in ((0, None, 0), (None, 0, 0), (0, 0, 0), (0, 0, None)):
        given = [
            x if axis is None else several
            for x, several, axis in zip(
                (PAIRS["own"], world(), at(*POSES[0])), (models, maps, states), axes, strict=True
            )
        ]
        found = jax.jit(jax.vmap(perceive, axes))(*given)
        for i in range(2):
            alone = (x if axis is None else one(x, i) for x, axis in zip(given, axes, strict=True))
            same(one(found, i), plain(*alone, latents=False))


@pytest.mark.parametrize("number", [1, 16, 20, 23, 24, 36, 37, 64, 100])
def test_about_sixteen_vehicles_look_at_a_time(number):
    sizes = []

    def look(vehicles):
        sizes.append(len(vehicles.yaw))
        return vehicles.yaw

    yaw = jnp.arange(float(number))
    vehicles = _fast._Vehicles(jnp.zeros(number, int), None, None, jnp.zeros((number, 3)), yaw)
    np.testing.assert_array_equal(_fast._in_turns(look, vehicles), yaw)
    assert len(sizes) == 1 and min(number, 11) <= sizes[0] <= 24


def test_it_is_what_encoders_make_of_the_patches_at_the_pose():
    terrain, state = rough(), driving()
    (found,) = perceived(PAIRS["shared"], terrain, state, latents=True)
    drawn = patches.query(terrain, state.position, state.rpy[2])
    elevation = TerrainEncoder(1).apply(SHARED.elevation, drawn.elevation[..., None])
    semantic = TerrainEncoder(3).apply(SHARED.semantic, drawn.rgb)
    latents = np.concatenate([elevation, semantic], axis=-1)
    assert found.latents.shape == (16, 16, 36)
    np.testing.assert_allclose(found.latents, latents, atol=1e-4)
    np.testing.assert_allclose(found.average, latents.mean((0, 1)), atol=1e-5)
    reduced = latents @ SHARED.reduce["kernel"] + SHARED.reduce["bias"]
    np.testing.assert_allclose(found.reduced, reduced.ravel(), atol=1e-4)


def test_the_first_layer_of_the_network_alone_learns_and_only_from_latents():
    def total(pairs, state, latents):
        seen = reduced(pairs, perceive(pairs, world(), state, latents=latents))
        return jnp.sum(seen[0].reduced ** 2) + sum(jnp.sum(x.average) for x in seen)

    pairs, state = (FIRST, SECOND), places()
    first, second = jax.grad(total)(pairs, state, True)
    assert all(np.any(leaf) for leaf in jax.tree.leaves(first.reduce))
    rest = replace(first, reduce=None), second
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(rest))
    by_pose = jax.grad(total, 1)(pairs, state, False)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(by_pose))
    with pytest.raises(TypeError, match=r"encoders.reduce: expected a model that keeps latents"):
        jax.grad(total)(pairs, state, False)


def test_ruts_are_seen():
    """By each vehicle its own, alike by both ways of looking."""
    terrain, states = world(classes=1), places(3)

    def of_all(looking, deep):
        def seen(state):
            about = state.position[:2] + jnp.linspace(-5, 5, 400)[:, None]
            ruts = Ruts.none(state.position).pressed(about, jnp.full(400, deep))
            return looking(PAIRS["shared"], replace(terrain, ruts=ruts), state, latents=True)

        return jax.jit(jax.vmap(seen))(states)

    found, expected = of_all(look, 1.0), of_all(_plain, 1.0)
    untouched = of_all(look, 0.0)
    as_mapped = jax.jit(jax.vmap(lambda x: look(PAIRS["shared"], terrain, x, latents=True)))
    for i in range(3):
        same(one(found, i), one(expected, i), share=0.02)
        same(one(untouched, i), one(as_mapped(states), i), share=0.02)
    assert np.abs(found[0].latents - untouched[0].latents).max() > 0.1
