import sys

import numpy as np
import pytest
from PIL import Image
from viewing.scenes import bare, scene

from vertiwm_jax import figures
from vertiwm_jax.config import ConfigError
from vertiwm_jax.viewing import movie


def test_what_moves_is_where_it_is():
    full = scene()
    with figures.style():
        figure, show = movie.draw(full)
    overhead, tilt, fusion = figure.axes
    for step in (0, 12, 20):
        show(step)
        (west, east), (south, north) = overhead.get_xlim(), overhead.get_ylim()
        x, y = full.state[step, :2]
        assert west < x < east and south < y < north
        lines = {line.get_label(): line.get_xydata() for line in overhead.lines}
        np.testing.assert_allclose(lines["driven"], full.state[: step + 1, :2])
        for strip in (tilt, fusion):
            assert strip.lines[-1].get_xdata() == pytest.approx([step / 10] * 2)
        body = np.array(overhead.patches[5].get_xy())[:4]
        np.testing.assert_allclose(body.mean(axis=0), [x, y], atol=1e-5)
        ahead = body[0] + body[1] - body[2] - body[3]
        assert np.arctan2(ahead[1], ahead[0]) == pytest.approx(full.state[step, 5], abs=1e-5)
    predicted = lines["predicted, 1.6 s at a time"]
    np.testing.assert_allclose(predicted[8:15], full.prediction.state[1, :, :2])
    show(9)
    assert len(overhead.lines[-1].get_xdata()) == 8


def test_a_gif_of_every_second_step(tmp_path):
    movie.write(scene(), tmp_path / "scene.gif")
    with Image.open(tmp_path / "scene.gif") as image:
        assert image.n_frames == 11 and image.info["duration"] == 200
        first = np.asarray(image.convert("RGB"), int)
        image.seek(10)
        assert np.abs(np.asarray(image.convert("RGB")) - first).max() > 100


def test_an_mp4(tmp_path, monkeypatch):
    movie.write(bare(), tmp_path / "scene.mp4")
    assert (tmp_path / "scene.mp4").read_bytes()[4:8] == b"ftyp"
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ConfigError, match=r'other\.mp4: expected .*"vertiwm-jax\[view\]"'):
        movie.write(bare(), tmp_path / "other.mp4")
