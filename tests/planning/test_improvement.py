from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import BICYCLE, begin, bicycle_env, ground, task
from flax import struct

from vertiwm_jax.env.agent import Now
from vertiwm_jax.env.controllers import StraightToGoal
from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.planning.improvement import ImprovementConfig, PolicyImprovement

CONFIG = NavigationConfig(horizon_seconds=15.0)
KEY = jax.random.key(0)


@struct.dataclass
class Always:
    """The same action, or the same value, whatever is seen."""

    answer: jax.Array

    def __call__(self, observation, key=None):
        return self.answer


@pytest.fixture(scope="module")
def blocked():
    """A goal straight ahead, behind a wall 3 m wide."""
    terrain = ground(obstacles=[[0.0, 0.0, 2.0, 3.0, 2.0]])
    return bicycle_env(terrain, task((-20.0, 0.0), (20.0, 0.0)), CONFIG)


def planner(env, correction=(0.0, 0.0), value=0.0, base=True, **config):
    return PolicyImprovement(
        env=env,
        dynamics=BICYCLE,
        policy=Always(jnp.array(correction)),
        value=Always(jnp.float32(value)),
        base=StraightToGoal(CONFIG) if base else None,
        interval=8,
        discount=0.9,
        config=ImprovementConfig(**config),
    )


@pytest.mark.integration
def test_without_alternatives_it_drives_as_the_policy_does(blocked):
    env, params = blocked
    for correction in ((0.0, 0.0), (0.1, 0.2)):
        alone = planner(env, correction, candidates=1, decisions=1)
        found = run_episodes(env, params, alone, KEY)
        led = replace(env, base=StraightToGoal(CONFIG))
        expected = run_episodes(led, params, Always(jnp.array(correction)), KEY)
        assert int(found.ending[0]) == int(expected.ending[0])
        np.testing.assert_allclose(found.path(0)[0], expected.path(0)[0], atol=1e-3)


def test_it_drives_around_what_its_policy_runs_into(blocked):
    env, params = blocked

    def ending(**config):
        ahead = planner(env, (0.3, 0.0), base=False, spread=0.6, **config)
        return run_episodes(env, params, ahead, KEY).ending[0]

    assert ending(candidates=1) == TerminationReason.COLLIDED
    assert ending(candidates=16, decisions=4) == TerminationReason.GOAL


@pytest.mark.integration
def test_a_future_is_worth_its_rewards_and_what_is_expected_at_its_end(blocked):
    env, params = blocked
    driver = planner(env, correction=(0.1, -0.3), value=7.0, decisions=3)
    now, first = begin(env, params), jnp.array([0.2, 0.3])
    found = jax.jit(driver.imagine)(now, first[None], KEY)
    repeated, total, actions = (
        replace(env, action_repeat=8, base=driver.base),
        0.0,
        [first] + [driver.policy(now.observation)] * 2,
    )
    state = now.state
    for i, action in enumerate(actions):
        _, state, reward, *_ = jax.jit(repeated.step_env)(KEY, state, action, params)
        total += 0.9**i * float(reward)
    assert float(found) == pytest.approx(total + 0.9**3 * 7.0, rel=1e-4)


@pytest.mark.parametrize("ending", [TerminationReason.COLLIDED, TerminationReason.TIMED_OUT])
@pytest.mark.integration
def test_nothing_is_expected_after_the_end(blocked, ending):
    env, params = blocked
    now = begin(env, params)
    state = now.state
    near = {"position": state.vehicle.position.at[0].set(-5.0)}
    if ending == TerminationReason.TIMED_OUT:
        params = params.replace(max_steps_in_episode=jnp.int32(3))
    else:
        state = replace(state, vehicle=replace(state.vehicle, **near))
    returns = [
        float(
            planner(env, value=value, decisions=4).imagine(
                Now(params, state, now.observation), jnp.array([[1.0, 0.0]]), KEY
            )
        )
        for value in (0.0, 1e6)
    ]
    assert returns[0] == returns[1]


@pytest.mark.integration
def test_its_model_follows_the_vehicle():
    """A planner that imagines in what really happens knows what only the simulator remembers."""
    simulator, params = Simulator(substeps=2), chrono_like(load_vehicle())
    env = NavigationEnv(simulator, CONFIG)
    tasks = task((-20.0, 0.0), (20.0, 0.0))
    env_params = env.make_params(params, ground(), tasks)
    driver = replace(planner(env, candidates=2, decisions=1), dynamics=params)
    now = begin(env, env_params)
    memory = driver.init(now)
    act, step = jax.jit(driver.act), jax.jit(env.step_env)
    for _ in range(15):
        action, memory = act(now, memory, KEY)
        observation, state, *_ = step(KEY, now.state, action, env_params)
        now = Now(env_params, state, observation)
    assert state.history.wheel_speed.min() > 2
    np.testing.assert_allclose(memory.history.wheel_speed, state.history.wheel_speed, atol=0.05)
    np.testing.assert_allclose(memory.history.travel, state.history.travel, atol=0.005)


@pytest.mark.parametrize(
    ("field", "value"), [("candidates", 0), ("decisions", 0), ("spread", -0.1)]
)
def test_settings_that_make_no_sense_are_refused(field, value):
    with pytest.raises(ValueError, match=rf"{field}: expected at least \d, found {value}"):
        ImprovementConfig(**{field: value})
