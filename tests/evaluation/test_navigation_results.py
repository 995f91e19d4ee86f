import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import bicycle_env, ground, hills
from flax import struct

from vertiwm_jax import machine, parallel
from vertiwm_jax.env.agent import Agent, Now
from vertiwm_jax.env.controllers import RandomActions, StraightToGoal
from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.suites import circle_tasks
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.evaluation import navigation
from vertiwm_jax.terrain import map as terrain_map

CONFIG = NavigationConfig(horizon_seconds=12.0)


@pytest.fixture(scope="module")
def short():
    """Six tasks of 52 m, of which some are blocked and none takes longer than 12 s."""
    block = [[0.0, 0.0, 12.0, 3.0, 2.0]]
    terrain = terrain_map.stack([ground(hills(), block), ground(hills())])
    return bicycle_env(terrain, circle_tasks(terrain, radius=26.0, pairs=3), CONFIG)


@pytest.fixture(scope="module")
def straight(short):
    return run_episodes(*short, StraightToGoal(CONFIG), jax.random.key(0))


@pytest.mark.integration
def test_agrees_with_a_loop_over_episodes(short, straight):
    env, params = short
    step, policy = jax.jit(env.step_env), StraightToGoal(CONFIG)
    for task in range(params.pool_size):
        observation, state = env.start(params, task)
        positions, tilts = [state.vehicle.position], []
        while state.ending == TerminationReason.RUNNING:
            action = policy(observation, jax.random.key(0))
            observation, state, *_ = step(jax.random.key(0), state, action, params)
            positions.append(state.vehicle.position)
            tilts.append(np.abs(state.vehicle.rpy))
        positions, tilts = np.array(positions), np.array(tilts)
        assert straight.ending[task] == state.ending
        assert straight.steps[task] == len(tilts) == state.time
        np.testing.assert_allclose(straight.abs_roll[task], tilts[:, 0].mean(), rtol=1e-3)
        np.testing.assert_allclose(straight.abs_pitch[task], tilts[:, 1].mean(), rtol=1e-3)
        driven = np.linalg.norm(np.diff(positions, axis=0), axis=-1).sum()
        np.testing.assert_allclose(straight.driven[task], driven, rtol=1e-3)
        path, rpy = straight.path(task)
        assert path.shape == rpy.shape == positions.shape
        np.testing.assert_allclose(path, positions, atol=1e-2)
        left = np.linalg.norm(positions[-1] - np.asarray(state.goal))
        np.testing.assert_allclose(straight.final_distance[task], left, atol=1e-2)


@struct.dataclass
class Wandering(Agent):
    """Goes to the goal, but to a side, which it decides at random and by where it is."""

    interval = 7

    def init(self, now):
        return jnp.float32(0)

    def plan(self, now, memory, key):
        jax.debug.callback(decided.append, now.state.time)
        return 0.3 * memory + 0.3 * jax.random.normal(key) + 0.01 * now.state.vehicle.position[1]

    def act(self, now, memory, key):
        return StraightToGoal(CONFIG)(now.observation, key).at[1].add(memory), memory


decided = []


@pytest.mark.parametrize("together", [1, 4, 100])
@pytest.mark.integration
def test_decides_for_each_that_drives_as_if_it_were_alone(short, together, monkeypatch):
    monkeypatch.setattr(machine, "together", lambda **_: together)
    jax.clear_caches()  # Or what was compiled for others together would be found.
    decided.clear()
    env, params = short
    wandering, key, interval = Wandering(), jax.random.key(3), Wandering.interval
    found = jax.block_until_ready(run_episodes(env, params, wandering, key))
    jax.effects_barrier()
    assert len(set(found.steps.tolist())) > 2  # Some drive on where others have ended.
    # Nothing is decided where all that decide together have ended.
    turn = min(together * parallel.mesh(params.pool_size).size, params.pool_size)
    driving = [sum(found.steps > time) for time in range(0, max(found.steps), interval)]
    assert len(decided) == sum(-(-number // turn) * turn for number in driving)
    step, length = jax.jit(env.step_env), int(params.max_steps_in_episode)
    for task in range(params.pool_size):
        observation, state = env.start(params, task)
        memory, time = jnp.float32(0), 0
        while state.ending == TerminationReason.RUNNING:
            if time % interval == 0:
                deciding = jax.random.fold_in(jax.random.fold_in(key, length), time)
                own = jax.random.split(deciding, params.pool_size)[task]
                memory = wandering.plan(Now(params, state, observation), memory, own)
            action, memory = wandering.act(Now(params, state, observation), memory, key)
            observation, state, *_ = step(key, state, action, params)
            time += 1
        assert (found.ending[task], found.steps[task]) == (state.ending, time)
        end = found.path(task)[0][-1]
        np.testing.assert_allclose(end, state.vehicle.position, atol=1e-2)


def test_summary_counts(straight):
    summary = navigation.summary(straight)
    ending = np.asarray(straight.ending)
    assert set(summary["endings"]) == {"goal", "collided"} and summary["tasks"] == 6
    assert summary["successes"] == (ending == TerminationReason.GOAL).sum()
    assert sum(summary["endings"].values()) == 6
    low, high = summary["success_interval"]
    assert low < summary["successes"] / 6 < high
    seconds = 0.1 * np.asarray(straight.steps)[ending == TerminationReason.GOAL]
    assert summary["seconds"] == pytest.approx(seconds.mean(), rel=1e-5)
    assert summary["seconds_deviation"] == pytest.approx(seconds.std(), rel=1e-3, abs=1e-5)
    every_step = np.concatenate([straight.path(i)[1][1:] for i in range(6)])
    roll, pitch, _ = np.abs(every_step).mean(axis=0)
    assert summary["abs_roll"] == pytest.approx(roll, rel=1e-4)
    assert summary["abs_pitch"] == pytest.approx(pitch, rel=1e-4)


def test_time_runs_out_and_nobody_succeeds(short):
    env, params = short
    params = params.replace(max_steps_in_episode=jnp.int32(7))
    result = run_episodes(env, params, StraightToGoal(CONFIG), jax.random.key(0))
    assert (result.ending == TerminationReason.TIMED_OUT).all() and (result.steps == 7).all()
    row = navigation.summary(result)
    assert row["successes"] == 0 and row["seconds"] is None
    assert "0/6" in navigation.format_table({"slow": row})


def test_other_weights_do_not_compile_again(short):
    @struct.dataclass
    class Weighted:
        weight: jax.Array

        @chex.assert_max_traces(n=1)
        def __call__(self, observation, key):
            return jnp.tanh(self.weight * observation[:2])

    chex.clear_trace_counter()
    for weight in (0.0, 1.0):
        run_episodes(*short, Weighted(jnp.float32(weight)), jax.random.key(0))


def test_table_has_the_paper_s_columns(straight):
    row = {
        "tasks": 20,
        "successes": 18,
        "success_interval": (0.699, 0.972),
        "seconds": 27.54,
        "seconds_deviation": 1.26,
        "abs_roll": np.radians(4.84),
        "abs_pitch": np.radians(3.76),
        "driven": 113.06,
        "endings": {"goal": 18, "stuck": 2},
    }
    assert set(row) == set(navigation.summary(straight))
    lines = navigation.format_table({"ppo": row, "straight to goal": row}).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert cells[0][:6] == ["policy", "success", "95 %", "time [s]", "roll [deg]", "pitch [deg]"]
    assert cells[2] == [
        "ppo", "18/20", "70-97", "27.5 ± 1.3", "4.84", "3.76", "113.1", "goal 18, stuck 2"
    ]  # fmt: skip
    assert len({len(line) for line in lines}) == 1


def test_random_actions_fill_the_box():
    policy = RandomActions()
    keys = jax.random.split(jax.random.key(0), 1000)
    actions = np.asarray(jax.vmap(policy, (None, 0))(jnp.zeros(5), keys))
    assert actions.shape == (1000, 2) and np.abs(actions).max() <= 1
    np.testing.assert_allclose(actions.mean(0), 0, atol=0.08)
    np.testing.assert_allclose(actions.std(0), 3**-0.5, atol=0.03)
