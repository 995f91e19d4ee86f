from dataclasses import dataclass, replace
from typing import get_args

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import BICYCLE, Scripted, bicycle_env, ground, hills, step_of_many, task
from flax import struct

from vertiwm_jax import parallel
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.observation import OBSERVATION_SIZE, WAITING, WAITING_SCALE
from vertiwm_jax.env.reward import RewardConfig
from vertiwm_jax.env.suites import circle_tasks
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.mechanics.kinematic import KinematicBicycle
from vertiwm_jax.mechanics.simulator import Simulator
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.models.registry import ModelName
from vertiwm_jax.rl import experiment as task_of_learning
from vertiwm_jax.rl.experiment import TaskConfig
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import map as terrain_map

KEY = jax.random.key(0)
AHEAD = jnp.array([1.0, 0.0])
# Equal environments share what it compiles.
STEP = jax.jit(NavigationEnv.step_env, static_argnums=0)
BLOCKED = ground(obstacles=[[9.0, 0.0, 2.0, 2.0, 1.0]])
OPEN = ground(obstacles=[[9.0, 50.0, 2.0, 2.0, 1.0]])


def drive(x, y=0.0, z=0.47, roll=0.0, speed=4.0):
    """States of a script, leaves `[T, 3]`, from whichever arguments are sequences."""
    x, y, z, roll, speed = np.broadcast_arrays(*map(np.atleast_1d, (x, y, z, roll, speed)))
    zero = np.zeros_like(x, np.float32)
    return VehicleState(
        *(
            jnp.asarray(np.stack(columns, axis=-1), jnp.float32)
            for columns in ((x, y, z), (roll, zero, zero), (speed, zero, zero), (zero,) * 3)
        )
    )


def play(script, steps, terrain=OPEN, goal=(30.0, 0.0), model=Scripted, **settings):
    """Outputs of `steps` steps of a script that starts at (0, 0)."""
    config = NavigationConfig(**settings)
    env = NavigationEnv(model(config.settle_steps), config)
    params = env.make_params(script, terrain, task((0.0, 0.0), goal))
    _, state = env.start(params, 0)
    outputs = []
    for _ in range(steps):
        observation, state, reward, terminated, info = STEP(env, KEY, state, AHEAD, params)
        truncated = env.is_truncated(state, params)
        outputs.append((observation, state, reward, bool(terminated), bool(truncated), info))
    return outputs


def endings(outputs):
    return [TerminationReason(int(info["ending"])).name for *_, info in outputs]


@pytest.mark.parametrize(
    ("script", "ending"),
    [
        (drive([10.0, 22.5]), "GOAL"),
        (drive([10.0, 20.0], y=[0.0, 63.5]), "OFF_MAP"),
        (drive([1.0, 2.0], roll=[0.5, -1.1]), "ROLLED_OVER"),
        (drive([1.0, 6.0]), "COLLIDED"),
        (drive([1.0, np.nan]), "DIVERGED"),
        (drive([1.0, 2.0], speed=[4.0, np.inf]), "DIVERGED"),
        (drive([1.0, 2.0], speed=[4.0, 40.0]), "DIVERGED"),
        (drive([1.0, 2.0], z=[0.5, 9.0]), "DIVERGED"),
    ],
)
def test_every_fault_ends_the_task(script, ending):
    outputs = play(script, 2, BLOCKED if ending == "COLLIDED" else OPEN)
    assert endings(outputs) == ["RUNNING", ending]
    assert [(o[3], o[4]) for o in outputs] == [(False, False), (True, False)]


def test_how_long_it_stalls_and_backs_up_is_counted():
    env, params = bicycle_env(
        ground(), task((0.0, 0.0), (30.0, 0.0)), NavigationConfig(speed_range=(-3.0, 5.0))
    )
    step, (_, state) = jax.jit(env.step_env), env.start(params, jnp.int32(0))
    counted = []
    for speed in (0.0, 0.0, -3.0, -3.0, 4.0):
        action = jnp.array([(speed + 3) / 4 - 1, 0.0])
        seen, state, *_ = step(jax.random.key(0), state, action, params)
        counted.append((int(state.stalled), int(state.backing)))
        np.testing.assert_allclose(seen[WAITING] * WAITING_SCALE, np.array(counted[-1]) / 10)
    assert [backing for _, backing in counted] == [0, 0, 1, 2, 0]
    assert [stalled for stalled, _ in counted][:2] == [1, 2] and counted[3][0] == 0


def test_a_diverged_state_never_leaves():
    (_, before, *_), (observation, after, reward, *_) = play(drive([1.0, np.nan]), 2)
    assert jnp.isfinite(observation).all() and jnp.isfinite(reward)
    chex.assert_trees_all_equal(after.vehicle, before.vehicle)


@pytest.mark.parametrize("last", [22.5, np.nan], ids=["goal", "diverged"])
def test_an_episode_that_is_over_stays_as_it_is(last):
    _, end, after = play(drive([10.0, last, 1.0]), 3)
    assert float(end[2]) != 0 and float(after[2]) == 0
    kept = [replace(state, history=()) for _, state, *_ in (end, after)]
    chex.assert_trees_all_equal((end[0], kept[0], *end[3:]), (after[0], kept[1], *after[3:]))


@struct.dataclass
class Divided:
    """A history of parts that disagree."""

    steps: jax.Array
    disagreement: jax.Array
    spread: jax.Array


@dataclass(frozen=True)
class Doubtful(Scripted):
    """The script; after every step that moved, parts are 1 cm more apart and spread 1 mm more."""

    def init(self, params, terrain, state):
        return Divided(super().init(params, terrain, state), jnp.float32(0), jnp.float32(0))

    def step(self, params, terrain, history, state, command):
        state, steps = super().step(params, terrain, history.steps, state, command)
        moved = jnp.maximum(steps, 0)
        return state, Divided(steps, 0.01 * moved, 0.001 * moved)


@pytest.mark.integration
def test_disagreement_within_a_model_costs_reward_and_ends_what_nobody_can_tell():
    script = drive([1.0, 2.0, 3.0, np.nan])
    alone = play(script, 4)
    settings = {"reward": RewardConfig(disagreement=100.0, spread=500.0)}
    divided = play(script, 4, model=Doubtful, **settings)
    for number, (one, other) in enumerate(zip(alone[:3], divided, strict=False), start=1):
        np.testing.assert_allclose(other[2], one[2] - 1.5 * number, rtol=1e-4)
    assert endings(divided)[-1] == "DIVERGED" and jnp.isfinite(divided[-1][2])
    ended = play(script, 3, model=Doubtful, plausible_disagreement=0.025)
    assert endings(ended) == ["RUNNING", "RUNNING", "DIVERGED"]


@pytest.mark.integration
def test_many_starts_are_those_of_each():
    terrain = ground(hills())
    many = circle_tasks(terrain, radius=50.0, pairs=300)
    some = jax.tree.map(lambda x: x[250:260], many)
    (_, all_), (_, few) = (bicycle_env(terrain, tasks) for tasks in (many, some))
    assert all_.pool_size == 300
    picked = jax.tree.map(lambda x: x[250:260], (all_.starts, all_.start_observation))
    assert all_.routes.cost.shape[0] == 300
    renumbered = few.starts.replace(route=250 + few.starts.route)
    chex.assert_trees_all_close(picked, (renumbered, few.start_observation), atol=1e-4)


def test_standing_is_stuck_only_without_a_break():
    speed = np.full(40, 0.1)
    speed[9] = 1.0
    outputs = play(drive(1.0, speed=speed), 20, stuck_seconds=1.0)
    assert endings(outputs).index("STUCK") == 19
    assert outputs[19][3] and not outputs[19][4]


def test_time_out_truncates_and_a_goal_at_the_last_step_terminates():
    far = play(drive(1.0), 3, horizon_seconds=0.3)
    assert [(o[3], o[4]) for o in far] == [(False, False)] * 2 + [(False, True)]
    assert endings(far)[-1] == "TIMED_OUT"
    # 29 m are left, and the settled start is level with the goal but for the axle height.
    distance = np.hypot(29.0, 0.47)
    np.testing.assert_allclose(far[-1][2], -100 - 10 * distance, rtol=1e-5)
    there = play(drive([1.0, 2.0, 25.0]), 3, horizon_seconds=0.3)
    assert (there[-1][3], there[-1][4]) == (True, False)


def test_reward_of_a_step_is_that_computed_by_hand():
    (first, second) = play(drive([1.0, 1.5], z=[0.47, 0.52], roll=[0.0, 0.6]), 2)
    before = np.hypot(29.0, 0.47)
    tilt = 20 * (0.6 / np.radians(30)) * (0.6 - np.radians(30))
    # On level ground the cost to go falls as the distance does.
    np.testing.assert_allclose(second[2], 50 * 0.5 - tilt - 0.5, rtol=1e-4)
    np.testing.assert_allclose(first[5]["distance"], before, rtol=1e-6)
    np.testing.assert_allclose(second[5]["abs_roll"], 0.6, rtol=1e-6)


def test_actions_are_commands_and_back():
    vehicle, speeds = load_vehicle().replace(steering_limit=jnp.float32(0.4)), (-1.0, 5.0)
    command = vehicle.command(jnp.array([[-1.0, 0.5], [1.0, -3.0], [0.0, 0.0]]), speeds)
    np.testing.assert_allclose(command.speed, [-1, 5, 2], rtol=1e-6)
    np.testing.assert_allclose(command.steering, [0.2, -0.4, 0], rtol=1e-6)
    action = vehicle.action(Command(jnp.float32(3.5), jnp.float32(-0.1)), speeds)
    np.testing.assert_allclose(action, [0.5, -0.25], rtol=1e-6)
    fast = Command(jnp.float32(9), jnp.float32(0))
    np.testing.assert_allclose(vehicle.action(fast, speeds), [1, 0])


def test_starts_stand_on_the_ground_and_resets_draw_all_of_them():
    terrain = terrain_map.stack([ground(hills()), ground()])
    env, params = bicycle_env(terrain, circle_tasks(terrain, radius=50.0, pairs=4))
    assert params.pool_size == 8 and int(params.max_steps_in_episode) == 600
    assert params.start_observation.shape == (8, OBSERVATION_SIZE)
    vehicle = params.starts.vehicle
    np.testing.assert_allclose(np.asarray(vehicle.position)[4:, 2], 0.47, rtol=1e-5)
    np.testing.assert_allclose(vehicle.velocity, 0, atol=1e-6)
    observation, state = jax.vmap(env.reset, (0, None))(jax.random.split(KEY, 200), params)
    assert len(np.unique(state.vehicle.position[:, :2], axis=0)) == 4
    assert len(np.unique(observation, axis=0)) == 8


@pytest.mark.integration
def test_a_start_is_what_the_model_begins_with():
    """Whose history the pool keeps without its empty caches."""
    model, params = task_of_learning.dynamics(TaskConfig(compute_dtype="float32"), "vertiwm")
    terrain = ground(hills())
    pool = circle_tasks(terrain, 55.0, 3)
    env = NavigationEnv(model, settling=Simulator())
    made = env.make_params(params, terrain, pool)
    _, start = env.start(made, 1)
    begun = jax.jit(model.init)(params, terrain, start.vehicle)
    chex.assert_trees_all_close(start.history, begun, atol=1e-5)
    chex.assert_trees_all_equal_shapes_and_dtypes(start.history, begun)
    assert sum(x.nbytes for x in jax.tree.leaves(made.starts)) < 3 * 20_000


@pytest.mark.integration
def test_step_compiles_once_and_resets_by_itself():
    terrain = terrain_map.stack([ground(hills()), ground(hills(height=0.5))])
    config = NavigationConfig(horizon_seconds=0.5)
    env, params = bicycle_env(terrain, circle_tasks(terrain, radius=50.0), config)
    n = 16
    states = jax.vmap(env.reset, (0, None))(jax.random.split(KEY, n), params)[1]
    step = step_of_many(env, AHEAD)
    for i in range(1, 6):
        _, states, _, terminated, truncated, info = out = step(jax.random.key(i), states, params)
        assert not terminated.any() and truncated.all() == (i == 5)
    # What the episode ended with, and the first of the next one.
    assert (info["ending"] == TerminationReason.TIMED_OUT).all() and (states.time == 0).all()
    final, first = np.asarray(info["final_observation"]), np.asarray(out[0])
    assert (final[:, 2] > 0.1).all() and (first[:, 2] == 0).all()
    assert set(map(bytes, first)) <= set(map(bytes, np.asarray(params.start_observation)))


@pytest.mark.parametrize("name", get_args(ModelName))
@pytest.mark.integration
def test_a_model_is_traced_once_for_starts_and_for_steps(name, monkeypatch):
    model, params = task_of_learning.dynamics(TaskConfig(compute_dtype="float32"), name)
    traced, step = [], type(model).step

    def noted(self, *args):
        traced.append(self)
        return step(self, *args)

    monkeypatch.setattr(type(model), "step", noted)
    jax.clear_caches()
    terrain = ground(hills())
    pool = circle_tasks(terrain, 55.0, 4)
    env, number = NavigationEnv(model), len(pool.world)
    made = env.make_params(params, terrain, pool)
    mesh = parallel.mesh(number)
    keys, actions = jax.random.split(KEY, number), jnp.zeros((number, 2))
    given = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=parallel.shardings(mesh)),
        (keys, made.starts, actions, made),
    )
    with jax.set_mesh(mesh):
        jax.eval_shape(parallel.vmap(env.step, (0, 0, 0, None)), *given)
    assert len(traced) == 1


@pytest.mark.integration
def test_worlds_are_not_copied_per_vehicle():
    worlds = terrain_map.stack([ground(hills())] * 8)
    env, params = bicycle_env(worlds, circle_tasks(worlds))
    n = 256
    states = jax.vmap(env.start, (None, 0))(params, jnp.arange(n) % 80)[1]

    def step(states, actions, params):
        return jax.vmap(env.step_env, (None, 0, 0, None))(KEY, states, actions, params)

    compiled = jax.jit(step).lower(states, jnp.zeros((n, 2)), params).compile()
    memory = compiled.memory_analysis()
    # One copy of one world for each vehicle would be 17 MB.
    assert memory.temp_size_in_bytes < 4e6


def test_equal_environments_are_one_static_argument():
    assert NavigationEnv(KinematicBicycle()) == NavigationEnv(KinematicBicycle())
    assert hash(NavigationEnv(KinematicBicycle())) == hash(NavigationEnv(KinematicBicycle()))


def test_a_patch_must_cover_the_next_footprint():
    with pytest.raises(ValueError, match="top speed"):
        config = NavigationConfig(speed_range=(0.0, 60.0))
        bicycle_env(ground(), task((0.0, 0.0), (30.0, 0.0)), config)


def test_a_model_that_cannot_stand_is_named():
    env = NavigationEnv(KinematicBicycle())
    broken = BICYCLE.replace(wheelbase=jnp.float32(jnp.nan))
    with pytest.raises(ValueError, match=r"dynamics: expected a finite state .*; task 0 has"):
        env.make_params(broken, ground(), task((0.0, 0.0), (30.0, 0.0)))
