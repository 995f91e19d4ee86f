from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import BICYCLE, bicycle_env, ground, task

from vertiwm_jax.dynamics import rollout
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.randomization import DomainRandomization, RandomizationConfig
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.mechanics.kinematic import KinematicBicycle
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap

KEYS = jax.random.split(jax.random.key(0), 200)
FLAT, TASK = ground(), task((0.0, 0.0), (30.0, 0.0))
STANDING = jnp.array([-1.0, 0.0])


def varied(config):
    env = NavigationEnv(KinematicBicycle(), NavigationConfig(), config)
    return env, env.make_params(BICYCLE, FLAT, TASK)


def test_episodes_draw_from_all_of_the_ranges():
    config = RandomizationConfig(grip=(0.5, 0.9), soil=(0.4, 1.2), delay=(1, 3))
    env, params = varied(config)
    drawn = jax.jit(jax.vmap(env.reset_env, (0, None)))(KEYS, params)[1].variation
    for factors, (low, high) in ((drawn.grip, config.grip), (drawn.soil, config.soil)):
        assert low <= factors.min() < low + 0.05 and high - 0.05 < factors.max() <= high
    assert set(np.asarray(drawn.delay).tolist()) == {1, 2, 3}
    assert abs(np.corrcoef(drawn.grip, drawn.soil)[0, 1]) < 0.2


def test_nothing_varies_by_default():
    env, params = bicycle_env(FLAT, TASK)
    variation = env.reset_env(KEYS[0], params)[1].variation
    assert jax.tree.leaves(variation) == [] and variation.ground(FLAT) is FLAT


@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.integration
def test_commands_come_late(delay):
    """A delayed vehicle does what one without a delay has done before."""
    env, params = varied(RandomizationConfig(delay=(delay, delay)))
    prompt_env, prompt = bicycle_env(FLAT, TASK)
    actions = jax.random.uniform(KEYS[0], (8, 2), minval=-1.0, maxval=1.0)

    def positions(env, params, actions):
        def advance(state, action):
            state = env.step_env(KEYS[0], state, action, params)[1]
            return state, state.vehicle.position

        return jax.lax.scan(advance, env.reset_env(KEYS[1], params)[1], actions)[1]

    late = jnp.concatenate([jnp.broadcast_to(STANDING, (delay, 2)), actions])[:8]
    expected = positions(prompt_env, prompt, late)
    np.testing.assert_allclose(positions(env, params, actions), expected, atol=1e-5)
    assert not np.allclose(expected[-1], positions(prompt_env, prompt, actions)[-1]) or not delay


def test_grip_scales_friction_and_soil_its_strength_wherever_the_ground_is_asked():
    variation = DomainRandomization(jnp.float32(0.5), jnp.float32(0.25), delay=None, sent=None)
    below = jnp.array([3.0, 4.0])
    grip = [query.surface(x, below).friction for x in (FLAT, variation.ground(FLAT))]
    np.testing.assert_allclose(grip[1], 0.5 * grip[0], rtol=1e-6)
    soils, weak = FLAT.soils, variation.ground(FLAT).soils
    for name in ("kc", "kphi", "cohesion"):
        np.testing.assert_allclose(getattr(weak, name), 0.25 * getattr(soils, name), rtol=1e-6)
    for name in ("n", "friction_angle"):
        np.testing.assert_array_equal(getattr(weak, name), getattr(soils, name))


def test_a_vehicle_climbs_less_on_varied_ground():
    """A third of the grip on a slope of rigid ground: the simulator, unlike a bicycle, slips."""
    slope = np.broadcast_to(0.45 * np.arange(129.0) * 0.1, (129, 129)).astype(np.float32)
    hill = TerrainMap.from_array(slope, np.full((16, 16), 3), resolution=0.1, origin=(-6.4, 6.4))
    model, params = Simulator(), chrono_like(load_vehicle())
    pitch = -np.arctan(0.45)
    start = VehicleState(
        jnp.array([-2.0, 0.0, query.height(hill, jnp.array([-2.0, 0.0])) + 0.55]),
        jnp.array([0.0, pitch, 0.0]), jnp.zeros(3), jnp.zeros(3),
    )  # fmt: skip

    @jax.jit
    def climbed(grip):
        terrain = replace(hill, grip=grip)
        commands = Command(jnp.full(20, 2.0), jnp.zeros(20))
        states = rollout(model, params, terrain, start, commands)
        return states.position[-1, 0] - start.position[0]

    assert climbed(jnp.float32(1.0)) > 0.5 + climbed(jnp.float32(0.3))


@pytest.mark.parametrize("wrong", [{"grip": (0.9, 0.5)}, {"soil": (0.0, 1.0)}, {"delay": (-1, 2)}])
def test_ranges_without_sense_are_refused(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}: expected"):
        RandomizationConfig(**wrong)
