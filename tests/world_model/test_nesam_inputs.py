from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from world_model.examples import CONSTANTS, commands, driving, one

from vertiwm_jax.mechanics.kinematic import place
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model import nesam_inputs
from vertiwm_jax.world_model.nesam_inputs import StepFeatures

CONCRETE, SNOW = 1, 9
VEHICLE = load_vehicle()
PHYSICS = chrono_like(VEHICLE)
ON_ROAD = TerrainMap.from_array(np.zeros((49, 49)), [[SNOW] * 12] * 6 + [[CONCRETE] * 12] * 6)
"""Snow to the north of y = 0, concrete to the south."""


def features(yaw: float) -> StepFeatures:
    """Of a vehicle that stands on the border."""
    state = place(ON_ROAD, yaw=yaw)
    memory = Simulator().init(PHYSICS, ON_ROAD, state)
    memory = replace(memory, sinkage=jnp.array([0.05, 0.0, 0.04, 0.0]), steering=jnp.float32(0.1))
    command, scale = one(commands(1), 0), jnp.ones(12)
    return StepFeatures.of(CONSTANTS, scale, VEHICLE, state, state, command, state, memory)


def test_tells_which_wheels_stand_on_what():
    east = features(0.0)
    sinkage, normal, soft, friction, stiffness = east.wheels[:, jnp.array([2, 4, 7, 9, 10])].T
    np.testing.assert_allclose(sinkage, [0.5, 0.0, 0.4, 0.0], atol=1e-6)
    np.testing.assert_allclose(normal, 1, atol=1e-5)
    np.testing.assert_array_equal(soft, [1, 0, 1, 0])
    assert (friction > 0).tolist() == [False, True, False, True]
    # Snow: 0.2 MN/m^(n+2).
    np.testing.assert_allclose(stiffness, [np.log(0.2), 0, np.log(0.2), 0], atol=1e-5)


def test_a_mirror_exchanges_left_and_right():
    east = features(0.0)
    image = east.mirrored
    np.testing.assert_array_equal(image.wheels[:, 7], [0, 1, 0, 1])
    steering = east.body[-1]
    assert float(steering) > 0
    assert float(image.body[-1]) == -float(steering)
    assert east.flat.shape == (nesam_inputs.SIZE,)
    np.testing.assert_array_equal(image.mirrored.flat, east.flat)


def test_signs_are_those_of_a_mirrored_state():
    state, later = driving(0), driving(1)
    signs = jnp.array([1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1.0])
    image, after = (VehicleState.from_vector(signs * x.vector) for x in (state, later))
    memory = Simulator().init(PHYSICS, ON_ROAD, state)
    command = one(commands(1), 0)
    opposite = replace(command, steering=-command.steering)
    arguments = CONSTANTS, jnp.ones(12), VEHICLE
    seen = StepFeatures.of(*arguments, state, state, command, later, memory)
    found = StepFeatures.of(*arguments, image, image, opposite, after, memory)
    np.testing.assert_allclose(found.body, seen.mirrored.body, atol=1e-3)


def test_large_values_are_cut_off():
    east = features(0.0)
    wild = east._replace(body=east.body.at[0].set(-1e9))
    assert float(jnp.abs(wild.flat).max()) == nesam_inputs.LARGEST
