from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env import worlds
from env.worlds import BICYCLE, begin, ground, task

from vertiwm_jax.env import route
from vertiwm_jax.env.agent import Now
from vertiwm_jax.env.controllers import StraightToGoal
from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.mechanics.kinematic import KinematicBicycle
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.planning.mppi import MPPI, MPPIConfig
from vertiwm_jax.terrain.sensing import SensingConfig

CONFIG = NavigationConfig(horizon_seconds=15.0)
KEY = jax.random.key(0)
SMALL = {"candidates": 16, "decisions": 4}


@dataclass(frozen=True)
class Pulling(KinematicBicycle):
    """A bicycle that steers to the left by itself, a little more after every step."""

    def init(self, params, terrain, state):
        return jnp.int32(0)

    def step(self, params, terrain, history, state, command):
        pulled = replace(command, steering=command.steering + 0.002 * history)
        state, _ = super().step(params, terrain, None, state, pulled)
        return state, history + 1


@pytest.fixture(scope="module")
def blocked():
    return worlds.blocked(CONFIG)


def driver(env, **config):
    return MPPI(env=env, dynamics=BICYCLE, config=MPPIConfig(**SMALL | config))


def decided(env, params, driver, start=0, corrections=None):
    """What is intended at a start, once decided with `KEY`, `[D, 2]`."""
    now = begin(env, params, start)
    memory = driver.init(now)
    if corrections is not None:
        memory = replace(memory, corrections=corrections)
    return jax.jit(driver.plan)(now, memory, KEY).corrections


@pytest.mark.integration
def test_it_drives_around_what_driving_straight_runs_into(blocked):
    env, params = blocked
    straight = run_episodes(env, params, StraightToGoal(CONFIG), KEY)
    assert (straight.ending == TerminationReason.COLLIDED).all()
    found = run_episodes(env, params, driver(env), KEY)
    assert (found.ending == TerminationReason.GOAL).all()


@pytest.mark.integration
def test_it_plans_in_what_it_has_seen_of_the_map():
    """What stands out of range changes no plan, and what comes into range is driven around."""
    seeing = replace(CONFIG, sensing=SensingConfig(range=12.0))
    intended = {}
    for config in (seeing, CONFIG):
        env, params = worlds.blocked(config)
        empty = replace(params, terrain=ground(obstacles=np.zeros((1, 5))))
        far = driver(env, decisions=10)
        intended[config] = [decided(env, x, far) for x in (params, empty)]
    np.testing.assert_array_equal(*intended[seeing])
    assert not np.allclose(*intended[CONFIG])
    env, params = worlds.blocked(seeing)
    found = run_episodes(env, params, driver(env), KEY)
    assert (found.ending == TerminationReason.GOAL).all()


@pytest.mark.integration
def test_the_model_follows_the_vehicle():
    """Whoever steers against the pull has to know how strong it has become."""
    env = NavigationEnv(Pulling(), replace(CONFIG, settle_steps=0))
    params = env.make_params(BICYCLE, ground(), task((-20.0, 0.0), (20.0, 0.0)))
    pulled = driver(env)
    assert run_episodes(env, params, pulled, KEY).ending[0] == TerminationReason.GOAL
    now = begin(env, params)
    memory = pulled.init(now)
    act, step = jax.jit(pulled.act), jax.jit(env.step_env)
    for _ in range(5):
        action, memory = act(now, memory, KEY)
        observation, state, *_ = step(KEY, now.state, action, params)
        now = Now(params, state, observation)
    assert int(memory.history) == int(state.history) == 5


def test_a_plan_without_alternatives_is_kept_and_moves_on(blocked):
    env, params = blocked
    plan = jnp.array([[0.1, 0.2], [0.3, -0.4], [0.5, 0.6], [-0.7, 0.8]])
    found = decided(env, params, driver(env, candidates=1), corrections=plan)
    np.testing.assert_allclose(found, plan[jnp.array([1, 2, 3, 3])], rtol=1e-6)


@pytest.mark.parametrize("temperature", [1e-3, 100.0, 1e9])
@pytest.mark.integration
def test_plans_count_by_what_they_return(blocked, temperature):
    env, params = blocked
    planner = driver(env, temperature=temperature, spread=0.5, clearance=0.0)
    noise_key, key = jax.random.split(KEY)
    noise = jax.random.normal(noise_key, (16, 4, 2)).at[0].set(0.0)
    plans = jnp.clip(0.5 * noise, -1.0, 1.0)
    imagine = jax.jit(jax.vmap(planner.imagine, (None, 0, None)))
    returns = np.asarray(imagine(begin(env, params), plans, key), float)
    weights = np.exp((returns - returns.max()) / temperature)
    expected = np.tensordot(weights / weights.sum(), plans, axes=1)
    if temperature < 1:
        np.testing.assert_allclose(expected, plans[returns.argmax()], atol=1e-6)
    if temperature > 1e6:
        np.testing.assert_allclose(expected, np.mean(plans, axis=0), atol=1e-5)
    np.testing.assert_allclose(decided(env, params, planner), expected, atol=1e-3)


def test_after_a_plan_it_goes_on_to_the_goal_at_a_steady_pace(blocked):
    env, params = blocked
    straight = route.straight(env.config.route, params.terrain, params.starts.goal[:, :2])
    params = replace(params, routes=straight)
    planner = driver(env, pace=5.0, discount=0.9)
    observation, state = env.start(params, jnp.int32(0))
    apart = jnp.linalg.norm(state.goal - state.vehicle.position)
    toward = (state.goal - state.vehicle.position) / apart
    near = state.goal - (8.0 + 3 * 4.0) * toward  # three decisions of 4 m from the goal's edge
    state = replace(state, vehicle=replace(state.vehicle, position=near))
    expected = (1 + 0.9 + 0.81) * 50.0 * 4.0 + 0.729 * 3000.0
    assert float(planner.expected(Now(params, state, observation))) == pytest.approx(
        expected, rel=2e-3
    )


@pytest.mark.integration
def test_tilting_costs_what_the_planner_says():
    """On a slope to the side that costs nothing in the task itself."""
    bank = 0.45
    slope = np.tan(bank) * np.arange(129.0)[:, None] * np.ones(129)
    env = NavigationEnv(KinematicBicycle(), CONFIG)
    params = env.make_params(BICYCLE, ground(slope), task((-40.0, 0.0), (40.0, 0.0)))
    now, straight = begin(env, params), jnp.zeros((4, 2))
    careless, careful = (
        float(driver(env, tilt=tilt, tilt_limit=0.3).imagine(now, straight, KEY))
        for tilt in (0.0, 200.0)
    )
    of_decision = 8 * 200 * bank / 0.3 * (bank - 0.3)
    expected = of_decision * sum(0.98**number for number in range(4))
    assert careless - careful == pytest.approx(expected, rel=0.03)
    assert env.config.reward.tilt_limit > bank


@pytest.mark.integration
@pytest.mark.parametrize(("start", "fails"), [(-12.0, True), (0.0, False)])
def test_plans_keep_clear_of_obstacles_unless_too_near_already(start, fails):
    """Of a wall that it passes 0.2 m from its side, or beside which it stands."""
    aside = float(load_vehicle().width) / 2 + 1.5 + 0.2
    env = NavigationEnv(KinematicBicycle(), CONFIG)
    params = env.make_params(
        BICYCLE, ground(obstacles=[[0.0, 0.0, 2.0, 3.0, 2.0]]), task((start, aside), (30.0, aside))
    )
    now, straight = begin(env, params), jnp.zeros((8, 2))

    def imagined(clearance):
        planner = driver(env, decisions=8, clearance=clearance)
        return float(planner.imagine(planner.inside(now, planner.init(now)), straight, KEY))

    lost = imagined(0.0) - imagined(0.3)
    assert lost > env.config.reward.failure if fails else lost == 0


@pytest.mark.integration
def test_many_decide_as_each_alone(blocked):
    env, params = blocked
    planner = driver(env)

    @jax.jit
    @jax.vmap
    def plan(start):
        now = begin(env, params, start)
        return planner.plan(now, planner.init(now), KEY).corrections

    together = plan(jnp.arange(2))
    for i in range(2):
        np.testing.assert_allclose(together[i], decided(env, params, planner, i), atol=1e-3)


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("candidates", 0, "at least 1"),
        ("decisions", 0, "at least 1"),
        ("interval", 0, "at least 1"),
        ("spread", -0.1, "at least 0"),
        ("temperature", 0.0, "more than 0"),
        ("tilt", -1.0, "at least 0"),
        ("tilt_limit", 0.0, "more than 0"),
        ("clearance", -0.1, "at least 0"),
        ("pace", 0.0, "more than 0"),
        ("discount", 1.0, "between 0 and 1"),
    ],
)
def test_settings_that_make_no_sense_are_refused(field, value, expected):
    with pytest.raises(ValueError, match=f"{field}: expected {expected}, found {value}"):
        MPPIConfig(**{field: value})
