import numpy as np
import pytest
from PIL import Image
from viewing.scenes import scene

from vertiwm_jax import figures
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
        in_body = overhead.patches[5].get_transform() - overhead.transData  # of a unit square
        rear, front, middle = in_body.transform([(0, 0), (1, 0), (0.5, 0.5)])
        np.testing.assert_allclose(middle, [x, y], atol=1e-5)
        ahead = front - rear
        assert np.arctan2(ahead[1], ahead[0]) == pytest.approx(full.state[step, 5], abs=1e-5)
    (ahead,) = overhead.collections
    np.testing.assert_allclose(ahead.get_segments()[1], full.prediction.state[1, :, :2])
    said = [text.get_text() for text in overhead.get_legend().get_texts()]
    assert said[-2:] == ["snow", "rock or tree"] and "predicted, 1.6 s at a time" in said
    show(9)
    assert len(ahead.get_segments()) == 1


def test_a_gif_of_every_second_step(tmp_path):
    movie.write(scene(), tmp_path / "scene.gif")
    with Image.open(tmp_path / "scene.gif") as image:
        assert image.n_frames == 11 and image.info["duration"] == 200
        first = np.asarray(image.convert("RGB"), int)
        image.seek(10)
        assert np.abs(np.asarray(image.convert("RGB")) - first).max() > 100
