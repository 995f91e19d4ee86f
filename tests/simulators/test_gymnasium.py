"""A simulator outside jit as a Gymnasium environment is the environment inside."""

import sys

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import SNOW, ground, hills, task
from gymnasium.utils.env_checker import check_env

from vertiwm_jax.env.gymnasium import NavigationGymEnv
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.suites import Tasks
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason as Reason
from vertiwm_jax.learning.dataset import WheelSignals
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.simulators.builtin import BuiltIn
from vertiwm_jax.simulators.chrono import Chrono
from vertiwm_jax.simulators.gymnasium import SimulatorEnv
from vertiwm_jax.simulators.protocol import Observation, SimulatorError
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain.map import TerrainMap

CONFIG = NavigationConfig(speed_range=(0.0, 5.0), horizon_seconds=6.0)
TASKS = Tasks(
    world=jnp.array([1, 1, 0, 1, 1, 0]),
    start=jnp.array([[-20.0, 0], [0, -30], [50, 0], [60, 0], [20, 20], [-20, -20]]),
    yaw=jnp.array([0.3, 0.0, 2.0, 0.0, 2.0, -2.0]),
    goal=jnp.array([[0.0, 0], [30, -30], [-50, 0], [-60, 0], [-20, 20], [20, -20]]),
)
AHEAD, STANDING = (1.0, 0.0), (-1.0, 0.0)


@pytest.fixture(scope="module")
def terrain():
    """Flat grass, and waves of concrete and snow with a box on them."""
    semantic = np.full((16, 16), SNOW)
    semantic[:, 8:] = 0
    box = np.array([[15.0, -30.0, 4, 4, 3]])
    return terrain_map.stack([ground(), TerrainMap.from_array(hills(), semantic, obstacles=box)])


@pytest.fixture(scope="module")
def both(terrain):
    """Environments of a single task, inside jit and outside."""
    env, vehicle = NavigationEnv(Simulator(), CONFIG), chrono_like(load_vehicle())

    def single(number):
        alone = jax.tree.map(lambda x: x[number : number + 1], TASKS)
        inside = NavigationGymEnv(env, env.make_params(vehicle, terrain, alone))
        return inside, SimulatorEnv(BuiltIn, terrain, alone, CONFIG)

    return single


class Ghost:
    """Stands where it is put, and then goes through given states."""

    def __init__(self, terrain, states=()):
        self.states, self.commands = iter(states), []

    def start(self, x, y, yaw):
        self.state = np.array([x, y, 0.5, 0, 0, yaw, *np.zeros(6)], np.float32)
        return self._seen()

    def step(self, command):
        self.commands.append(command)
        self.state = self.state + next(self.states, np.zeros(12, np.float32))
        return self._seen()

    def _seen(self):
        return Observation(self.state, np.zeros(4, np.uint8), WheelSignals())


def haunted(*changes):
    """An environment in which a ghost's state changes by `[12]` in each step, and its ghosts."""
    ghosts = []

    def call(terrain):
        ghosts.append(Ghost(terrain, changes))
        return ghosts[-1]

    return SimulatorEnv(call, ground(), task((0, 0), (50, 0))), ghosts


def change(x=0.0, z=0.0, roll=0.0):
    """`[12]`"""
    return np.array([x, 0, z, roll, *np.zeros(8)], np.float32)


@pytest.mark.parametrize(
    ("number", "action", "ending"),
    [
        (0, AHEAD, Reason.GOAL),
        (1, AHEAD, Reason.COLLIDED),
        (2, AHEAD, Reason.TIMED_OUT),
        (3, AHEAD, Reason.OFF_MAP),
        (4, STANDING, Reason.STUCK),
        (5, None, Reason.TIMED_OUT),
    ],
)
@pytest.mark.integration
def test_episodes_outside_jit_are_those_inside(both, number, action, ending):
    inside, outside = both(number)
    (expected, _), (found, _) = inside.reset(seed=0), outside.reset(seed=0)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    swerving = np.random.default_rng(0).uniform([-0.2, -1], [1, 1], (60, 2))
    for drawn in swerving.astype(np.float32):
        chosen = drawn if action is None else np.array(action, np.float32)
        expected, reward, *over, info = inside.step(chosen)
        found, our_reward, *our_over, our_info = outside.step(chosen)
        assert our_over == over
        np.testing.assert_allclose(found, expected, atol=2e-3)
        # Rewards reach thousands, of which float32 keeps seven digits.
        np.testing.assert_allclose(our_reward, reward, rtol=1e-5, atol=2e-3)
        assert our_info == pytest.approx(info, abs=2e-3)
        if any(over):
            break
    late = ending == Reason.TIMED_OUT
    assert our_info["ending"] == ending.name.lower() and over == [not late, late]


@pytest.mark.filterwarnings("error", "ignore:.*not having a spec")
def test_it_passes_gymnasium_s_own_check(terrain):
    check_env(SimulatorEnv(BuiltIn, terrain, TASKS, CONFIG, render_mode="rgb_array"))


def test_a_seed_decides_which_task_is_driven(terrain):
    called = []

    def call(selected):
        called.append(int(selected.world))
        return Ghost(selected)

    env = SimulatorEnv(call, terrain, TASKS)

    def begin(seed):
        env.reset(seed=seed)
        vehicle, goal = env._state.vehicle, env._state.goal
        yaw = float(vehicle.rpy[2])
        return (called[-1], *vehicle.position[:2].tolist(), yaw, *goal[:2].tolist())

    begun = [begin(seed) for seed in range(30)]
    assert begun == [begin(seed) for seed in range(30)]
    columns = np.column_stack([TASKS.world, TASKS.start, TASKS.yaw, TASKS.goal])
    assert set(begun) == {tuple(row) for row in columns.tolist()}


def test_the_simulator_is_told_metres_a_second_and_radians():
    env, ghosts = haunted()
    env.reset(seed=0)
    for action in ([0.0, -0.5], [7.0, 1.0]):
        env.step(np.array(action, np.float32))
    np.testing.assert_allclose(ghosts[0].commands, [[2.5, -0.18625], [5.0, 0.3725]], rtol=1e-6)


@pytest.mark.parametrize(
    ("end", "ending"),
    [
        (change(roll=1.1), Reason.ROLLED_OVER),
        (change(z=np.nan), Reason.DIVERGED),
        (change(x=45), Reason.GOAL),
    ],
)
def test_what_the_simulator_does_ends_the_episode(end, ending):
    env, ghosts = haunted(change(x=1), end)
    env.reset(seed=0)
    _, _, *over, info = env.step(np.zeros(2, np.float32))
    assert over == [False, False] and info["ending"] == "running"
    np.testing.assert_allclose(info["distance"], np.hypot(49, 0.5), rtol=1e-5)
    observation, _, *over, info = env.step(np.zeros(2, np.float32))
    assert over == [True, False] and info["ending"] == ending.name.lower()
    assert observation in env.observation_space
    env.reset()
    assert len(ghosts) == 2 and env.step(np.zeros(2, np.float32))[4]["ending"] == "running"


def test_a_step_needs_a_reset():
    env, ghosts = haunted()
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2, np.float32))
    assert not ghosts


def test_tasks_that_cannot_be_driven_are_refused():
    with pytest.raises(ValueError, match="task 0 has world 0, start"):
        SimulatorEnv(Ghost, ground(), task((0, 0), (500, 0)))


def test_without_pychrono_it_is_said_where_it_comes_from(monkeypatch):
    monkeypatch.setitem(sys.modules, "pychrono", None)
    env = SimulatorEnv(Chrono, ground(), task((0, 0), (50, 0)))
    with pytest.raises(SimulatorError, match="conda install -c projectchrono"):
        env.reset()
