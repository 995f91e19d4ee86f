from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.learning.autoencoders import AutoencoderConfig, PatchData, Places, SoilProblem
from vertiwm_jax.networks.encoder import LATENT_CHANNELS
from vertiwm_jax.networks.soil_predictor import SoilPredictor
from vertiwm_jax.perception.features import init_pair
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import BOUNDS, PRESETS, to_unit

NAMES = terrain_map.STANDARD.names
GRASS, MUD, SNOW = (NAMES.index(name) for name in ("grass", "mud", "snow"))
PROBLEM = SoilProblem(AutoencoderConfig(batch=8, validation=2))
LATENT = jnp.zeros((16, 16, LATENT_CHANNELS))


def params():
    keys = jax.random.split(jax.random.key(0))
    semantic = init_pair(keys[0]).semantic
    return {"semantic": semantic, "soil": SoilPredictor().init(keys[1], LATENT)}


def data(*kinds):
    """One flat world of each kind of ground, and a place in the middle of each."""
    world = np.arange(len(kinds))
    maps = [TerrainMap.from_array(np.zeros((65, 65)), np.full((8, 8), kind)) for kind in kinds]
    terrain = terrain_map.stack(maps)
    places = Places(jnp.zeros((len(kinds), 3)), jnp.zeros(len(kinds)), jnp.asarray(world))
    return PatchData(places, terrain, places, terrain)


def test_shares_say_where_in_its_bounds_a_soil_lies():
    predicted = SoilPredictor().apply(params()["soil"], LATENT + 1.0)
    shares = to_unit(predicted)
    assert shares.shape == (6,) and np.all((shares > 0) & (shares < 1))
    low, high = (
        replace(PRESETS["mud"], **{name: np.float32(bound[i]) for name, bound in BOUNDS.items()})
        for i in (0, 1)
    )
    np.testing.assert_allclose(to_unit(low), 0, atol=1e-6)
    np.testing.assert_allclose(to_unit(high), 1, atol=1e-6)


def test_error_is_of_soil_alone():
    mud = PROBLEM.validate(params(), data(MUD, MUD))
    both = PROBLEM.validate(params(), data(MUD, GRASS))
    assert float(both["error"]) == pytest.approx(float(mud["error"]), rel=1e-5)
    assert float(PROBLEM.validate(params(), data(GRASS, GRASS))["error"]) == 0
    squares = [float(mud[f"error_{name}"]) ** 2 for name in BOUNDS]
    assert float(mud["error"]) == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-5)


def test_descent_tells_two_soils_apart():
    worlds, now, loss = data(MUD, SNOW), params(), jax.jit(jax.value_and_grad(PROBLEM.loss))
    first = float(PROBLEM.validate(now, worlds)["error"])
    for step in range(150):
        _, gradient = loss(now, worlds, jax.random.key(step))
        assert not any(np.any(x) for x in jax.tree.leaves(gradient["semantic"]))
        soil = jax.tree.map(lambda x, g: x - 0.3 * g, now["soil"], gradient["soil"])
        now = {**now, "soil": soil}
    assert float(PROBLEM.validate(now, worlds)["error"]) < 0.3 * first
