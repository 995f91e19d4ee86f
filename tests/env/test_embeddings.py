"""Policies see the ground by the world model's encoders, whatever moves the vehicle."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import BICYCLE, SNOW, Scripted, hills, task

from vertiwm_jax.checkpoints import CheckpointError
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.observation import (
    GROUND,
    IMAGE_SHAPE,
    OBSERVATION_LIMIT,
    OBSERVATION_SIZE,
)
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.mechanics.kinematic import KinematicBicycle
from vertiwm_jax.models import files
from vertiwm_jax.models.config import ModelConfig
from vertiwm_jax.models.registry import load_encoders, load_model
from vertiwm_jax.perception.perceive import embed
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain.map import TerrainMap

CONFIG = NavigationConfig(speed_range=(0.0, 5.0), settle_steps=1, embeddings=True)
BLIND = NavigationConfig(speed_range=(0.0, 5.0), settle_steps=1)


def picture(numbers):
    """Tiles as an image `[16, 16, 37]`."""
    return np.asarray(numbers).reshape(4, 4, 4, 4, 37).swapaxes(1, 2).reshape(16, 16, 37)


@pytest.fixture(scope="module")
def terrain():
    semantic = np.full((16, 16), SNOW)
    semantic[:, 8:] = 0
    return TerrainMap.from_array(hills(), semantic)


def stepped(config, dynamics, params, terrain, encoders=None):
    """Environment, and observation and state after a step at full speed."""
    env = NavigationEnv(dynamics, config)
    params = env.make_params(
        params, terrain, task((-5.0, 3.0), (30.0, 20.0), yaw=0.4), encoders=encoders
    )
    assert params.start_observation.shape == (1, *env.observation_space().shape)
    _, state = env.start(params, 0)
    step = jax.jit(partial(env.step_env, jax.random.key(0)))
    seen, state, *_ = step(state, jnp.array([1.0, 0.3]), params)
    return env, seen, state


@pytest.mark.parametrize("name", ["vertiwm", "builtin"])
@pytest.mark.integration
def test_an_observation_ends_with_the_ground_as_the_encoders_see_it(name, terrain):
    moves = load_model(name, embeddings=True)
    env, seen, state = stepped(CONFIG, *moves, terrain, load_encoders())
    assert seen.shape == (OBSERVATION_SIZE + 16 * 16 * 37,)
    assert env.config.observed.layout.image == IMAGE_SHAPE == (16, 16, 37)
    expected = jax.jit(embed)(files.load(files.PRETRAINED)[1].encoders[0], terrain, state.vehicle)
    assert float(jnp.std(expected)) > 0.1 and float(jnp.max(jnp.abs(expected))) < OBSERVATION_LIMIT
    found = picture(seen[OBSERVATION_SIZE:])
    np.testing.assert_allclose(found[..., :-1], expected, atol=1e-4)
    assert not found[..., -1].any()


@pytest.mark.integration
def test_seeing_does_not_change_how_a_model_moves(terrain):
    moves = load_model("builtin")
    _, seen, state = stepped(CONFIG, *moves, terrain, load_encoders())
    _, blind, alone = stepped(BLIND, *moves, terrain)
    np.testing.assert_allclose(state.vehicle.vector, alone.vehicle.vector, atol=1e-5)
    np.testing.assert_allclose(seen[:OBSERVATION_SIZE], blind, atol=1e-5)


def test_an_obstacle_and_the_edge_of_the_map_stand_in_the_picture(terrain):
    """The last channel, in which the first row is farthest ahead and the first column left."""
    box = np.array([[-45.0, 3.0, 1.8, 1.0, 1.0]], np.float32)
    ground = TerrainMap.from_array(np.asarray(terrain.elevation[0]), obstacles=box)
    config = replace(CONFIG, arcs=False)

    def walls(x, y, yaw):
        env = NavigationEnv(KinematicBicycle(), config)
        pool = task((x, y), (20.0, 20.0), yaw=yaw)
        params = env.make_params(BICYCLE, ground, pool, encoders=load_encoders())
        left = params.cost_to_go(env.start(params, 0)[1])  # The way is a straight line.
        np.testing.assert_allclose(left, np.hypot(x - 20, y - 20), atol=0.2)
        return picture(params.start_observation[0, GROUND.start :])[..., -1]

    # It is 4.1 to 5.9 m ahead and 1 m wide; cells are 0.8 m, from 6.4 m ahead and to the left on.
    ahead = walls(-50.0, 3.0, 0.0)
    expected = np.zeros((16, 16))
    expected[0:3, 7:9] = 1
    np.testing.assert_array_equal(ahead, expected)
    # Of a vehicle that has turned to the left, it is on the right.
    np.testing.assert_array_equal(walls(-50.0, 3.0, np.pi / 2), np.rot90(ahead, -1))
    beyond = walls(float(ground.extent[0][0]) + 3.0, 3.0, 0.0)
    assert beyond[12:].all() and not beyond[:12, 7:9].any()


def test_what_is_seen_where_a_model_diverged_is_finite(terrain):
    script = VehicleState(jnp.full((1, 3), jnp.nan), *(jnp.zeros((1, 3)),) * 3)
    moves = Scripted(CONFIG.settle_steps), script
    _, seen, state = stepped(CONFIG, *moves, terrain, load_encoders())
    assert state.ending == TerminationReason.DIVERGED and bool(jnp.all(jnp.isfinite(seen)))


def test_a_model_without_encoders_is_refused(terrain):
    env = NavigationEnv(KinematicBicycle(), CONFIG)
    with pytest.raises(ValueError, match="embeddings: expected a model that was loaded with them"):
        env.make_params(BICYCLE, terrain, task((0.0, 0.0), (30.0, 0.0)))


def test_policies_see_by_the_encoders_of_a_transformer(tmp_path):
    """NeSAM's own would show them something else than what they learned from."""
    config, params = files.load(files.PRETRAINED)
    config = replace(config, encoders="own")
    first, second = replace(params.encoders[0], soil=None), replace(params.encoders[0], reduce=None)
    files.save(tmp_path, config, replace(params, encoders=(first, second)))
    found = load_encoders(tmp_path)
    assert found.reduce is found.soil is None
    np.testing.assert_array_equal(*(x.semantic["params"]["cell_bias"] for x in (found, first)))
    files.save(tmp_path / "soil", ModelConfig(parts=("nesam",), gates=4), files.load(tmp_path)[1])
    with pytest.raises(CheckpointError, match="soil: expected the encoders of a Transformer"):
        load_encoders(tmp_path / "soil")
