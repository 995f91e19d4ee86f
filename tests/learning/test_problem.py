"""What a model learns from a batch of windows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learning import recordings

from vertiwm_jax.learning.dataset import load_drives
from vertiwm_jax.learning.problem import WindowConfig, WindowData, WindowProblem, guessed
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import PRIORS, load_vehicle


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_guesses_are_as_wrong_as_is_asked_for(share):
    given, keys = load_vehicle(), jax.random.split(jax.random.key(0), 999)
    drawn = jax.vmap(lambda key: guessed(given, share, key))(keys)
    for name, prior in PRIORS.items():
        off = np.log(np.asarray(getattr(drawn, name)) / np.asarray(getattr(given, name)))
        np.testing.assert_allclose(off.std(axis=0), share * prior, rtol=0.1, atol=1e-6)
    np.testing.assert_array_equal(drawn.mass, given.mass)


@pytest.mark.parametrize("noise", [0.0, 0.4])
def test_each_window_is_learned_with_a_guess_of_its_vehicle(tmp_path, noise):
    recordings.write(tmp_path)
    drives, terrain = load_drives(tmp_path, "train")
    config = WindowConfig(batch=64, context=2, horizon=3, validation=2, vehicle_noise=noise)
    data = WindowData.of(config, (drives, terrain), (drives, terrain))
    params = chrono_like(load_vehicle())

    def loss(objective, seed):
        problem = WindowProblem(Simulator(), objective, config)
        return float(problem.loss(params, data, jax.random.key(seed)))

    gain = float(params.vehicle.speed_gain)
    one, other = (loss(lambda own, *_: own.vehicle.speed_gain, seed) for seed in range(2))
    spread = loss(lambda own, *_: jnp.log(own.vehicle.speed_gain / gain) ** 2, 0) ** 0.5
    assert (one == other == gain) == (noise == 0)
    assert spread == pytest.approx(noise * PRIORS["speed_gain"], rel=0.3)
