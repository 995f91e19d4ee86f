"""A policy is judged external jit as it is inside."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import SNOW, hills

from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.observation import OBSERVATION_SIZE
from vertiwm_jax.env.suites import Tasks
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason as Reason
from vertiwm_jax.evaluation import external
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.models.registry import load_encoders
from vertiwm_jax.simulators import processes
from vertiwm_jax.simulators.builtin import BuiltIn
from vertiwm_jax.terrain.map import TerrainMap


@pytest.fixture(scope="module")
def inside():
    """Tasks, what `run_episodes` drives them with, and how it does."""
    semantic = np.full((16, 16), SNOW)
    semantic[:, 8:] = 0
    box = np.array([[15.0, -30.0, 4, 4, 3]])
    terrain = TerrainMap.from_array(hills(), semantic, obstacles=box)
    tasks = Tasks(
        world=jnp.zeros(3, jnp.int32),
        start=jnp.array([[-20.0, 0.0], [0.0, -30.0], [50.0, 0.0]]),
        yaw=jnp.array([0.3, 0.0, 1.0]),
        goal=jnp.array([[0.0, 0.0], [30.0, -30.0], [-50.0, 0.0]]),
    )
    config = NavigationConfig(speed_range=(0.0, 5.0), horizon_seconds=6.0, embeddings=True)
    env = NavigationEnv(Simulator(), config)
    params = env.make_params(chrono_like(load_vehicle()), terrain, tasks, encoders=load_encoders())
    arguments = env, params, jax.tree_util.Partial(led_by_embedding), jax.random.key(0)
    return tasks, arguments, run_episodes(*arguments)


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.integration
def test_the_built_in_simulator_outside_jit_is_that_inside(inside, jobs):
    tasks, arguments, episodes = inside
    with processes.simulating(jobs) as mapped:
        found = external.evaluate(BuiltIn, mapped, tasks, *arguments)
    assert found.ending.tolist() == [
        Reason.GOAL,
        Reason.COLLIDED,
        Reason.TIMED_OUT,
    ]
    for name in ("ending", "steps", "world"):
        np.testing.assert_array_equal(getattr(found, name), getattr(episodes, name))
    for name in ("position", "rpy", "abs_roll", "abs_pitch", "driven", "final_distance"):
        ours, theirs = getattr(found, name), getattr(episodes, name)
        np.testing.assert_allclose(ours, theirs, atol=1e-2, err_msg=name)


def led_by_embedding(observation, key):
    """Straight on, but for what the embedding of the ground is on average."""
    return jnp.array([1.0, 0.01 * jnp.mean(observation[OBSERVATION_SIZE:])])
