from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env import worlds
from env.worlds import BICYCLE, bicycle_env, ground, hills, task

from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.mechanics.kinematic import KinematicBicycle
from vertiwm_jax.planning.shooting import Shooting, ShootingConfig

CONFIG = NavigationConfig(speed_range=(0.0, 6.0), horizon_seconds=15.0)
KEY = jax.random.key(0)
SMALL = {"candidates": 8, "improved": 2, "decisions": 4}


@dataclass(frozen=True)
class Broken(KinematicBicycle):
    """A bicycle, faster to the left, whose gradient is NaN when it steers to the right."""

    def step(self, params, terrain, history, state, command):
        left = jnp.sqrt(jnp.maximum(command.steering, 0.0) ** 2)
        faster = replace(command, speed=command.speed + left)
        return super().step(params, terrain, history, state, faster)


@pytest.fixture(scope="module")
def blocked():
    return worlds.blocked(CONFIG)


@pytest.fixture(scope="module")
def hilly():
    return bicycle_env(ground(hills()), task((-20.0, 0.0), (20.0, 0.0)), CONFIG)


def driver(env, **config):
    return Shooting(env=env, dynamics=BICYCLE, config=ShootingConfig(**SMALL | config))


def started(env, params, driver, corrections=None, start=0):
    now = worlds.begin(env, params, start)
    memory = driver.init(now)
    if corrections is not None:
        memory = replace(memory, corrections=corrections)
    return now, memory


def drawn(number, decisions=4, key=KEY):
    return jax.random.uniform(key, (number, decisions, 2), minval=-0.8, maxval=0.8)


@pytest.mark.integration
def test_it_drives_around_what_driving_straight_runs_into(blocked):
    env, params = blocked
    found = run_episodes(env, params, driver(env), KEY)
    assert (found.ending == TerminationReason.GOAL).all()


@pytest.mark.integration
def test_the_gradient_is_that_of_finite_differences(hilly):
    env, params = hilly
    planner = driver(env)
    now, _ = started(env, params, planner)
    smooth = jax.jit(planner.smooth_return)
    plan, nudge = drawn(1)[0], 1e-3
    found = jax.jit(jax.grad(planner.smooth_return, argnums=1))(now, plan)
    for place in np.ndindex(plan.shape):
        above, below = (float(smooth(now, plan.at[place].add(sign * nudge))) for sign in (1, -1))
        difference = (above - below) / (2 * nudge)
        assert float(found[place]) == pytest.approx(difference, rel=0.03, abs=2.0)


@pytest.mark.integration
def test_steps_improve_what_a_plan_returns_smoothly(hilly):
    env, params = hilly
    planner = driver(env, steps=4, rate=0.05)
    now, memory = started(env, params, planner)
    worth = jax.jit(jax.vmap(planner.smooth_return, (None, 0)))
    improve = jax.jit(planner.improve)
    plans = drawn(16)
    for _ in range(2):
        better = improve(planner.inside(now, memory), plans)
        assert float(jnp.max(jnp.abs(better))) <= 1.0
        assert (worth(now, better) > worth(now, plans)).all()
        plans = better


@pytest.mark.integration
def test_a_step_turns_a_plan_away_from_a_rock_that_it_passes_too_near():
    """To the goal the vehicle has only to go straight on; a rock stands a little to its right."""
    terrain = ground(obstacles=[[-10.0, -2.2, 2.0, 2.0, 2.0]])
    across = task((-20.0, 0.0), (20.0, 0.0))
    env, params = bicycle_env(terrain, across, CONFIG)
    _, free = bicycle_env(ground(), across, CONFIG)
    planner = driver(env, decisions=3)
    plan = jnp.tile(jnp.array([0.3, 0.0]), (3, 1))

    def steered(params):
        now, _ = started(env, params, planner)
        return float(jax.jit(jax.grad(planner.smooth_return, argnums=1))(now, plan)[0, 1])

    assert steered(params) > abs(steered(free)) + 10


@pytest.mark.parametrize("speed", [0.3, 1.0])
@pytest.mark.integration
def test_a_sharp_smooth_return_is_the_task_s(blocked, speed):
    """At 1 the plan runs into the wall, at 0.3 it stops short of it."""
    env, params = blocked
    sharp = driver(env, clearance=1e-3, leeway=1e-3, discount=0.9999)
    now, _ = started(env, params, sharp)
    plan = jnp.tile(jnp.array([speed, 0.0]), (4, 1))
    found = jax.jit(sharp.smooth_return)(now, plan)
    expected = jax.jit(sharp.imagine)(now, plan, KEY)
    assert (float(expected) < 500) == (speed == 1.0)
    assert float(found) == pytest.approx(float(expected), rel=2e-3)


@pytest.mark.integration
def test_what_it_intends_is_worth_more_than_any_plan_it_drew(blocked):
    env, params = blocked
    planner = driver(env)
    now, memory = started(env, params, planner, drawn(1)[0])
    noise = jax.random.normal(KEY, (8, 4, 2)).at[0].set(0.0)
    plans = jnp.clip(planner.intended(now, memory) + 0.5 * noise, -1.0, 1.0)
    decided = jax.jit(planner.plan)(now, memory, KEY).corrections
    worth = jax.jit(jax.vmap(planner.smooth_return, (None, 0)))
    worth = worth(planner.inside(now, memory), jnp.concatenate([plans, decided[None]]))
    assert float(worth[-1]) > float(worth[:-1].max()) + 1.0


@pytest.mark.integration
def test_a_plan_without_alternatives_is_kept_and_moves_on(blocked):
    env, params = blocked
    plan = jnp.array([[0.1, 0.2], [0.3, -0.4], [0.5, 0.6], [-0.7, 0.8]])
    alone = driver(env, candidates=1, improved=1, steps=0)
    now, memory = started(env, params, alone, plan)
    found = jax.jit(alone.plan)(now, memory, KEY).corrections
    np.testing.assert_allclose(found, plan[jnp.array([1, 2, 3, 3])], rtol=1e-6)


@pytest.mark.integration
def test_a_gradient_that_is_not_finite_leaves_its_plan_and_no_other():
    env = NavigationEnv(Broken(), replace(CONFIG, settle_steps=0))
    params = env.make_params(BICYCLE, ground(), task((-20.0, 0.0), (20.0, 0.0)))
    planner = driver(env)
    now, memory = started(env, params, planner)
    plans = jnp.array([[[0.2, 0.1]] * 4, [[0.2, -0.1]] * 4])
    found = jax.jit(planner.improve)(planner.inside(now, memory), plans)
    assert not np.allclose(found[0], plans[0]) and np.isfinite(found).all()
    np.testing.assert_array_equal(found[1], plans[1])


@pytest.mark.integration
def test_it_compiles_once(blocked):
    env, params = blocked
    planner, traces = driver(env), []

    @jax.jit
    def plan(driver, *arguments):
        traces.append(1)
        return driver.plan(*arguments)

    for start in (0, 1):
        now, memory = started(env, params, planner, start=start)
        key = jax.random.key(start)
        memory = plan(planner, now, memory, key)
        plan(planner, now, memory, key)
    assert len(traces) == 1


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("candidates", 0, "at least 1"),
        ("improved", 0, "at least 1"),
        ("improved", 33, "1 to the 32 candidates"),
        ("steps", -1, "at least 0"),
        ("rate", 0.0, "more than 0"),
        ("clearance", 0.0, "more than 0"),
        ("leeway", -0.1, "more than 0"),
    ],
)
def test_settings_that_make_no_sense_are_refused(field, value, expected):
    with pytest.raises(ValueError, match=f"{field}: expected {expected}, found {value}"):
        ShootingConfig(**{field: value})
