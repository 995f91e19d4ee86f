"""Logs of recorded drives, and the way back: the script beside the notebooks."""

import numpy as np
import pytest
from doors import door, refusal, squeezed
from importers.noisy import noisy_logs
from learning import recordings

from vertiwm_jax.learning import dataset, schema
from vertiwm_jax.terrain import files, query

QUIET = ("--noise.position", "0", "--noise.attitude", "0", "--noise.latency", "0")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """25 drives of 4 s that stay on their map."""
    folder, state = tmp_path_factory.mktemp("recorded"), recordings.drives()["state"]
    state[..., 2] = 1.5
    recordings.write(folder, state=state * 0.2)
    return folder


def test_logs_of_a_rover_are_imported_as_they_were_recorded(recorded, tmp_path, capsys):
    logs = tmp_path / "logs"
    argv = [str(recorded), "--output", str(logs), "--vehicle", "rover", *QUIET]
    noisy_logs.main([*argv, "--noise.dropped", "0"])
    printed = capsys.readouterr().out.splitlines()
    # 25 drives of 4 s take 4 s over the root of ten each.
    assert printed[0].startswith("0.5 minutes of logs")
    (command,) = (line for line in printed if "import_drives" in line)
    small = files.load_map(next((logs / "maps").glob("*.npz")))
    known = files.load_map(next((recorded / "maps").glob("*.npz")))
    np.testing.assert_allclose(10 * small.resolution, known.resolution)
    words = command.split("vertiwm_jax.import_drives ")[1].replace("DRIVES", str(tmp_path))
    door("import_drives")(words.split())
    # What is said is in the rover's own seconds and metres.
    said = capsys.readouterr().out
    assert "| 50.0 |" in squeezed(said)
    above = float(said.split("the body origin is ")[1].split()[0])
    found, terrain = dataset.load_drives(tmp_path / words.split("/")[-1], "train")
    before, ground = dataset.load_drives(recorded, "train")
    height = np.asarray(query.height(ground, before.state[..., :2]))
    assert 10 * above == pytest.approx(np.median(before.state[..., 2] - height), abs=0.02)
    np.testing.assert_allclose(terrain.elevation, ground.elevation, rtol=1e-5)
    np.testing.assert_allclose(terrain.soils.kphi, ground.soils.kphi, rtol=1e-4)
    steps = found.state.shape[1]
    assert 39 <= steps <= 41
    np.testing.assert_allclose(found.state, before.state[:, :steps], atol=0.02)
    np.testing.assert_allclose(found.control, before.control[:, : steps - 1], atol=1e-4)
    _, meta = schema.read(next((tmp_path / words.split("/")[-1]).glob("*.npz")))
    np.testing.assert_allclose(meta["vehicle"]["wheels_in_body_xy"][0], [1.56, 1.0])


def test_what_cannot_be_logged_is_named(recorded, tmp_path):
    (tmp_path / "none").mkdir()
    other = ("--output", tmp_path / "logs")
    assert "expected .npz files" in refusal(noisy_logs.main, tmp_path / "none", *other)
    message = refusal(noisy_logs.main, recorded, *other, "--vehicle", "rovr")
    assert "did you mean 'rover'" in message
    assert not (tmp_path / "logs").exists()
    assert "expected no such folder yet" in refusal(noisy_logs.main, recorded, "--output", recorded)
