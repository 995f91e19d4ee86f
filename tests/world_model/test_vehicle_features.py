from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from world_model.examples import CONSTANTS, TINY, commands, driving, moved, rough
from world_model.test_nesam import Damped

from vertiwm_jax import froude
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.world_model import vehicle_features
from vertiwm_jax.world_model.nesam import Nesam
from vertiwm_jax.world_model.transformer import Transformer
from vertiwm_jax.world_model.vehicle_features import MOST, SIZE, described

HMMWV, KEY, TERRAIN = load_vehicle(), jax.random.key(0), rough()


def test_the_hmmwv_is_all_zeros():
    np.testing.assert_allclose(jax.jit(described)(HMMWV), np.zeros(SIZE), atol=1e-6)


def test_only_the_last_number_knows_the_size():
    same, tall = described(load_vehicle("rover")), froude.scaled(load_vehicle("rover"), 1.5)
    np.testing.assert_allclose(described(tall)[:-1], same[:-1], atol=1e-5)
    assert described(tall)[-1] - same[-1] == pytest.approx(np.log(1.5), rel=1e-4)


@pytest.mark.parametrize("field", ["mass", "wheel_torque", "brake_torque", "spring", "hull"])
def test_what_differs_is_told(field):
    other = replace(HMMWV, **{field: 1.2 * getattr(HMMWV, field)})
    assert np.abs(described(other)).max() > 0.01


def test_extreme_vehicles_are_cut_off():
    strong = replace(HMMWV, wheel_torque=jnp.float32(1e9))
    assert np.abs(described(strong)).max() == MOST


@pytest.mark.parametrize("reads", [True, False])
@pytest.mark.parametrize("kind", ["transformer", "nesam"])
def test_a_specialist_that_is_told_moves_another_vehicle_otherwise(kind, reads):
    """Of other brakes, which act on neither: physics here does not know the vehicle."""
    if kind == "transformer":
        model = Transformer(TINY, "none", reads)
        params = moved(model.init_params(KEY, CONSTANTS))
    else:
        model = Nesam(TINY, simulator=Damped(), reads_vehicle=reads)
        params = model.init_params(KEY, chrono_like(HMMWV), CONSTANTS)
        params = moved(replace(params, correction_scale=0.1 * CONSTANTS.transition_deviation))
    state, command = driving(), jax.tree.map(lambda x: x[0], commands(1))

    def proposed(factor):
        vehicle = replace(HMMWV, brake_torque=factor * HMMWV.brake_torque)
        history = model.init(params, vehicle, TERRAIN, state)
        ahead, _ = model.propose(params, vehicle, TERRAIN, None, history, state, command)
        return ahead.vector

    apart = np.abs(proposed(1.0) - proposed(2.0)).max()
    assert (apart > 1e-5) == reads, apart
    assert described(HMMWV).size == vehicle_features.SIZE
