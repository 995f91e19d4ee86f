from dataclasses import replace
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax import runs
from vertiwm_jax.learning import autoencoders, dataset, fitting
from vertiwm_jax.learning.autoencoders import (
    AutoencoderConfig,
    AutoencoderProblem,
    PatchData,
    Places,
)
from vertiwm_jax.learning.fitting import FitConfig
from vertiwm_jax.networks.encoder import TerrainEncoder
from vertiwm_jax.runs import Run
from vertiwm_jax.terrain import patches
from vertiwm_jax.terrain.map import TerrainMap

DRIVES = Path(__file__).parents[1] / "data" / "chrono_drives"
CONFIG = AutoencoderConfig(batch=4, validation=8)


@pytest.fixture(scope="module")
def recorded():
    return dataset.load_drives(DRIVES, "train")


@pytest.fixture(scope="module")
def data(recorded):
    return PatchData.of(CONFIG, recorded, recorded)


@pytest.fixture(scope="module")
def params():
    return AutoencoderProblem(CONFIG).init_params(jax.random.key(0))


def test_places_are_those_of_the_valid_steps(recorded):
    drives, _ = recorded
    length = np.arange(len(drives.length)) + 3
    places = Places.of(replace(drives, length=length))
    assert len(places.yaw) == (length + 1).sum()
    np.testing.assert_array_equal(places.position[4:9], drives.state[1, :5, :3])
    np.testing.assert_array_equal(places.yaw[4:9], drives.state[1, :5, 5])
    np.testing.assert_array_equal(places.world[4:9], drives.world[1])


def test_a_moved_vehicle_stays_on_the_map_as_high_above_the_ground():
    rise = np.tile(0.1 * np.arange(33.0), (33, 1)) + 4
    terrain = TerrainMap.from_array(rise, np.full((8, 8), 3))
    position = jnp.array([2.0, -3.0, 7.0])
    for offset, xy in (((5.0, 1.0), (7, -2)), ((30.0, 1.0), (16, -2)), ((0.0, -30.0), (2, -16))):
        moved = autoencoders._move(terrain, position, jnp.array(offset))
        np.testing.assert_allclose(moved[:2], xy)
        np.testing.assert_allclose(moved[2], 7 + 0.1 * (xy[0] - 2), rtol=1e-5)


def test_errors_are_in_metres_and_pixels(data, params, monkeypatch):
    ground = data.validation_terrain

    def off(_, seen):
        """20 cm too high everywhere, and grey on the right half."""
        colours = seen.rgb.at[:, 64:].set(ground.class_rgb[1] / 127.5 - 1)
        return replace(seen, elevation=seen.elevation + 0.2 / 4.0, rgb=colours)

    monkeypatch.setattr(autoencoders, "reconstruct", off)
    found = AutoencoderProblem(CONFIG).validate(params, data)
    assert float(found["elevation_rms"]) == pytest.approx(0.2, rel=1e-4)
    places, right = data.validation, []
    for i in range(len(places.yaw)):
        world = ground.select(places.world[i])
        rgb = patches.query(world, places.position[i], places.yaw[i]).rgb
        concrete = np.isclose(rgb, ground.class_rgb[1] / 127.5 - 1, atol=1e-3).all(axis=-1)
        right.append(0.5 + concrete[:, 64:].sum() / concrete.size)
    assert float(found["colour_accuracy"]) == pytest.approx(np.mean(right), abs=1e-4)


@pytest.mark.integration
def test_training_reconstructs_better_and_gives_encoders(data, params, tmp_path):
    config = FitConfig(updates=40, updates_per_iteration=20, learning_rate=3e-3, warm_up=5)
    problem, run = AutoencoderProblem(CONFIG), Run.create(tmp_path, "autoencoders", config)
    # Untrained networks reconstruct the smooth ground of three worlds too well to tell.
    detuned = jax.tree.map(lambda weight: 0.8 * weight, params)
    fitted = fitting.fit(problem, config, detuned, data, jax.random.key(1), run)
    before = jax.jit(problem.validate)(detuned, data)
    last = runs.read_metrics(run.folder)[-1]
    assert last["best_error"] < 0.3 * before["error"]
    assert last["elevation_rms"] < 0.5 * before["elevation_rms"]
    assert last["colour_accuracy"] > 0.9
    chex.assert_trees_all_equal(fitting.load(run.folder, params), fitted)

    encoders = autoencoders.encoders(fitted)
    seen = patches.query(data.terrain, data.places.position[0], data.places.yaw[0])
    for channels, weights, patch in (
        (1, encoders["elevation"], seen.elevation[..., None]),
        (3, encoders["semantic"], seen.rgb),
    ):
        latent = TerrainEncoder(channels).apply(weights, patch)
        assert latent.shape == (16, 16, 18)
    again = autoencoders.reconstruct(fitted, seen)
    assert again.elevation.shape == (128, 128)
    assert float(jnp.abs(again.elevation - seen.elevation).mean()) < 0.05


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"batch": 0}, "batch: expected at least 1, found 0"),
        ({"offset": -1.0}, "offset: expected at least 0, found -1.0"),
    ],
)
def test_settings_out_of_range_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **change)
