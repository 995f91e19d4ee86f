import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vertiwm_jax as vw
from vertiwm_jax import cli
from vertiwm_jax import config as configuration
from vertiwm_jax.config import ConfigError
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import VehicleConfig
from vertiwm_jax.terrain import files

STEPS = 24


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Drives of a vehicle that minds its speed more than the HMMWV, at changing speeds."""
    folder = tmp_path_factory.mktemp("drives")
    ground = vw.TerrainMap.from_array(np.zeros((129, 129)), "grass")
    (folder / "maps").mkdir()
    files.save(ground, folder / "maps" / "level.npz")
    hmmwv = vehicle.load("hmmwv")
    driven = chrono_like(replace(hmmwv, speed_gain=1.6 * hmmwv.speed_gain).vehicle)
    speed = 2 + np.random.default_rng(0).uniform(-1, 2, (8, 3)).repeat(STEPS // 3, axis=1)
    control = np.stack([speed, np.full_like(speed, 0.05)], axis=-1).astype(np.float32)

    @jax.jit
    def drive(control):
        start = vw.place(ground, speed=2.0)
        states = vw.rollout(Simulator(), driven, ground, start, vw.Command.from_vector(control))
        return jnp.concatenate([start.vector[None], states.vector])

    state = np.asarray(jax.lax.map(drive, jnp.asarray(control)))
    np.savez(
        folder / "drives.npz",
        state=state,
        control=control,
        length=np.full(8, STEPS),
        wheel_class=np.full((8, STEPS + 1, 4), 3, np.uint8),
        meta=json.dumps({"map": "level.npz"}),
    )
    return folder


def test_a_number_is_found_from_drives(drives, tmp_path):
    true = 1.6 * vehicle.load("hmmwv").speed_gain
    output = tmp_path / "mine.yaml"
    cli.main("identify", [str(drives), "--output", str(output), "--free", "speed_gain"])
    found = configuration.load(VehicleConfig, output)
    assert found.speed_gain == pytest.approx(true, rel=0.05)
    assert replace(found, speed_gain=1.0) == replace(vehicle.load("hmmwv"), speed_gain=1.0)


def test_what_cannot_be_identified_is_named(drives):
    with pytest.raises(ConfigError, match=r"free: speed_gan: .*did you mean 'speed_gain'"):
        vw.identify(drives, free=("speed_gan",))
