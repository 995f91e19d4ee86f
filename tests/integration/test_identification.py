import json
import shutil
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vertiwm_jax as vw
from vertiwm_jax import cli
from vertiwm_jax import config as configuration
from vertiwm_jax.config import ConfigError
from vertiwm_jax.evaluation import prediction
from vertiwm_jax.evaluation.prediction import Interval
from vertiwm_jax.learning import experiment, identification
from vertiwm_jax.learning.dataset import load_drives
from vertiwm_jax.learning.identification import MASS, NINETY, Identified, Number
from vertiwm_jax.learning.schema import DataError
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


def test_what_drives_tell_is_found_and_the_rest_stays_vague(drives, tmp_path, capsys):
    output, picture = tmp_path / "mine.yaml", tmp_path / "mine.png"
    free = "speed_gain", "wheel_torque", "tyre_friction"
    options = ["--free", *free, "--horizon", "8", "--output", f"{output}"]
    cli.main("identify", [str(drives), *options, "--picture", f"{picture}"])
    given, found = vehicle.load("hmmwv"), configuration.load(VehicleConfig, output)
    assert found.speed_gain == pytest.approx(1.6 * given.speed_gain, rel=0.05)
    assert replace(found, **{name: getattr(given, name) for name in free}) == given
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "| speed_gain    | 1.6" in capsys.readouterr().out

    again = vw.identify(drives, free=free, horizon=8)
    gain, torque, friction = again.numbers
    assert gain.low < 1.6 < gain.high
    assert gain.told > 0.8
    # The ground of grass has less friction than the tires.
    assert friction.factor == pytest.approx(1, abs=0.01)
    assert friction.told < 0.05
    assert again.after[-1] < 0.2 * again.before[-1]
    assert torque.ratio is not None
    wide, narrow = (np.log(high / low) for low, high in ((torque.low, torque.high), torque.ratio))
    assert wide > 2 * NINETY * MASS
    assert wide > narrow


def test_a_delay_is_found(drives, tmp_path):
    late = tmp_path / "late"
    shutil.copytree(drives, late)
    with np.load(drives / "drives.npz") as recorded:
        arrays = dict(recorded)
    # Told a step earlier than they act: what is told last acts no more.
    arrays["control"][:, :-1] = arrays["control"][:, 1:]
    np.savez(late / "drives.npz", **arrays)
    delay, low, high = vw.identify(late, free=("speed_gain",), horizon=8).delay
    assert low < delay < high
    assert delay == pytest.approx(0.1, abs=0.01)


def test_a_stuck_vehicle_tells_nothing(drives, tmp_path):
    """It stands, whatever it is told, as one does that hangs on a rock."""
    stuck = tmp_path / "stuck"
    shutil.copytree(drives, stuck)
    with np.load(drives / "drives.npz") as recorded:
        arrays = dict(recorded, split=np.full(8, "train"))
    np.savez(stuck / "drives.npz", **arrays)
    alone = vw.identify(stuck, free=("speed_gain",), horizon=8).vehicle
    np.savez(stuck / "moving.npz", **arrays)
    arrays["state"][:] = arrays["state"][:, :1] * np.repeat([1, 1, 0, 0], 3)
    np.savez(stuck / "drives.npz", **arrays)
    np.savez(stuck / "more.npz", **arrays)
    beside = vw.identify(stuck, free=("speed_gain",), horizon=8).vehicle
    assert beside.speed_gain == pytest.approx(alone.speed_gain, rel=1e-3)
    (stuck / "moving.npz").unlink()
    with pytest.raises(DataError, match="expected drives in which the vehicle moves"):
        vw.identify(stuck, free=("speed_gain",), horizon=8)


def test_logs_are_imported_first_and_a_model_is_adapted_then(tmp_path, monkeypatch, capsys):
    time, fitted = 0.1 * np.arange(100), []
    yaw, speed = 0.1 * time, np.full_like(time, 2.0)
    x, y = np.cumsum(0.2 * np.cos(yaw)), np.cumsum(0.2 * np.sin(yaw))
    log, settings, output = tmp_path / "log.csv", tmp_path / "settings.yaml", tmp_path / "my.yaml"
    names, columns = "time,x,y,yaw,speed,steer", (time, x, y, yaw, speed, 0 * speed + 0.165)
    np.savetxt(log, np.stack(columns, 1), delimiter=",", header=names, comments="")
    settings.write_text(
        "vehicle: {wheelbase: 3.302, track: 1.82, wheel_radius: 0.467}\nplane: concrete\n"
        "table: {time: time, position: [x, y], yaw: yaw, speed: speed, steering: steer}\n"
    )

    def run(config):
        fitted.append(config)
        return tmp_path / "run"

    monkeypatch.setattr(experiment, "run", run)
    argv = [str(log), "--output", str(output), "--free", "speed_gain", "--horizon", "4"]
    with pytest.raises(SystemExit, match=r"map: expected with settings"):
        cli.main("identify", [*argv, "--map", "map.npz"])
    asked = [*argv, "--settings", str(settings), "--model"]
    with pytest.raises(SystemExit, match="none"):
        cli.main("identify", [*asked, str(tmp_path / "none")])
    assert not output.exists() and not output.with_suffix(".drives").exists()
    cli.main("identify", [*asked, "any_vehicle"])
    (config,) = fitted
    assert config.data == (tmp_path / "my.drives",)
    assert config.model.vehicles == "any" and config.start.name == "any_vehicle"
    assert len(load_drives(config.data, "all")[0].length) == 1
    assert f"--weights {tmp_path / 'run' / 'model'}" in capsys.readouterr().out


@pytest.mark.parametrize("better", [True, False])
def test_a_model_is_adapted_with_the_numbers_that_it_predicts_best_with(
    drives, better, tmp_path, monkeypatch, capsys
):
    fitted, output = [], str(tmp_path / "my.yaml")
    given = vehicle.load("hmmwv")
    numbers = (Number("mass", 1.0, 0.9, 1.1, 2.0, None),)
    found = Identified(given, numbers, (0.0, 0.0, 0.0), np.ones(8), np.ones(8))
    gain = Interval(0.02, 0.01 if better else -0.01, 0.03)
    monkeypatch.setattr(experiment, "run", lambda config: fitted.append(config) or tmp_path)
    monkeypatch.setattr(identification, "identify", lambda *_, **__: found)
    monkeypatch.setattr(prediction, "gain", lambda *_: gain)
    cli.main("identify", [str(drives), "--output", output, "--model", "any_vehicle"])
    kept, which = (output, "found") if better else ("hmmwv", "given")
    assert [config.vehicle for config in fitted] == [kept]
    told = capsys.readouterr().out
    assert f"adapted with what was {which}" in told and f"--vehicle {kept}" in told


def test_what_cannot_be_identified_is_named(drives):
    with pytest.raises(ConfigError, match=r"free: speed_gan: .*did you mean 'speed_gain'"):
        vw.identify(drives, free=("speed_gan",))
    with pytest.raises(ConfigError, match="free: drive: expected a field of numbers, found 'all'"):
        vw.identify(drives, free=("drive",))
