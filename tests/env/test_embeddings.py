"""Policies see the ground by the world model's encoders, whatever moves the vehicle."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import BICYCLE, SNOW, Scripted, hills, task

from vertiwm_jax.checkpoints import CheckpointError
from vertiwm_jax.dynamics import EMBEDDING_SHAPE
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.observation import OBSERVATION_LIMIT, OBSERVATION_SIZE
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.mechanics.kinematic import KinematicBicycle
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.world_model import model
from vertiwm_jax.world_model.choice import choose, sighted
from vertiwm_jax.world_model.model import ModelConfig, VertiWM
from vertiwm_jax.world_model.perception import Sighted

CONFIG = NavigationConfig(speed_range=(0.0, 5.0), settle_steps=1, embeddings=True)
BLIND = NavigationConfig(speed_range=(0.0, 5.0), settle_steps=1)


@pytest.fixture(scope="module")
def terrain():
    semantic = np.full((16, 16), SNOW)
    semantic[:, 8:] = 0
    return terrain_map.build(hills(), semantic)


def stepped(config, dynamics, params, terrain):
    """Environment, and observation and state after a step at full speed."""
    env = NavigationEnv(dynamics, config)
    params = env.make_params(params, terrain, task((-5.0, 3.0), (30.0, 20.0), yaw=0.4))
    assert params.start_observation.shape == (1, *env.observation_space().shape)
    _, state = env.start(params, 0)
    step = jax.jit(partial(env.step_env, jax.random.key(0)))
    seen, state, *_ = step(state, jnp.array([1.0, 0.3]), params)
    return env, seen, state


@pytest.mark.parametrize("name", ["vertiwm", "builtin"])
def test_an_observation_ends_with_the_ground_as_the_encoders_see_it(name, terrain):
    env, seen, state = stepped(CONFIG, *sighted(name, *choose(name)), terrain)
    assert seen.shape == (OBSERVATION_SIZE + 16 * 16 * 36,) and env.senses.image == EMBEDDING_SHAPE
    config, params = model.load(model.PRETRAINED)
    eyes = config.transformer.exteroception
    expected = eyes.encode(params.transformer.encoders, eyes.query(terrain, state.vehicle)).latent
    assert float(jnp.std(expected)) > 0.1 and float(jnp.max(jnp.abs(expected))) < OBSERVATION_LIMIT
    tiles = seen[OBSERVATION_SIZE:].reshape(4, 4, 4, 4, 36)
    for row, column in np.ndindex(16, 16):
        found = tiles[row // 4, column // 4, row % 4, column % 4]
        np.testing.assert_allclose(found, expected[row, column], atol=1e-4)


def test_seeing_does_not_change_how_a_model_moves(terrain):
    moves = choose("builtin")
    _, seen, state = stepped(CONFIG, *sighted("builtin", *moves), terrain)
    _, blind, alone = stepped(BLIND, *moves, terrain)
    np.testing.assert_allclose(state.vehicle.vector, alone.vehicle.vector, atol=1e-5)
    np.testing.assert_allclose(seen[:OBSERVATION_SIZE], blind, atol=1e-5)


def test_what_is_seen_where_a_model_diverged_is_finite(terrain):
    script = VehicleState(jnp.full((1, 3), jnp.nan), *(jnp.zeros((1, 3)),) * 3)
    moves = sighted("builtin", Scripted(CONFIG.settle_steps), script)
    _, seen, state = stepped(CONFIG, *moves, terrain)
    assert state.ending == TerminationReason.DIVERGED and bool(jnp.all(jnp.isfinite(seen)))


def test_a_model_without_eyes_is_refused(terrain):
    env = NavigationEnv(KinematicBicycle(), CONFIG)
    with pytest.raises(ValueError, match="embeddings: expected a model that sees patches"):
        env.make_params(BICYCLE, terrain, task((0.0, 0.0), (30.0, 0.0)))


def test_own_encoders_are_not_taken_for_the_transformers(tmp_path):
    """NeSAM's own would show policies something else than what they learned from."""
    _, params = VertiWM.pretrained()
    config = ModelConfig(gates=len(params.gate))
    model.save(tmp_path, config, params)
    chosen = choose("nesam", tmp_path)
    dynamics, found = sighted("nesam", *chosen, tmp_path)
    assert dynamics.dynamics == chosen[0] and found.dynamics is chosen[1]
    for name, kept in (("vertiwm", True), ("transformer", True), ("builtin", False)):
        moves = choose(name, tmp_path)
        found, _ = sighted(name, *moves, tmp_path)
        assert isinstance(found, Sighted) != kept
    model.save(tmp_path / "soil", replace(config, parts=("nesam",)), params)
    with pytest.raises(CheckpointError, match="soil: expected the encoders of a Transformer"):
        sighted("nesam", *choose("nesam", tmp_path / "soil"), tmp_path / "soil")
