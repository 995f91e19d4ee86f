import io

import numpy as np
import pytest
from env.worlds import GRASS, SNOW, ground, hills

from vertiwm_jax.evaluation import plots
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain import picture
from vertiwm_jax.terrain.map import TerrainMap


def test_hills_are_lit_from_the_north_west_and_classes_tinted():
    x = np.arange(129.0)
    ridge = np.broadcast_to(8 - np.abs(x - 64) / 8, (129, 129))  # runs south to north
    semantic = np.full((16, 16), GRASS)
    semantic[:8, :8] = SNOW
    shaded = picture.shaded(TerrainMap.from_array(ridge, semantic), 0, enlarge=2)
    assert shaded.shape == (256, 256, 3) and shaded.min() >= 0 and shaded.max() <= 1
    assert shaded[200, 40].sum() > shaded[200, 216].sum()  # western flank, eastern flank
    assert shaded[40, 40, 2] > shaded[200, 40, 2] + 0.1  # snow north-west, grass south-west
    turned = picture.shaded(TerrainMap.from_array(ridge.T, semantic), 0, enlarge=2)
    assert turned[40, 200].sum() > turned[216, 200].sum()  # northern flank, southern flank


def test_trajectories_show_every_drive():
    t = np.linspace(0, 1, 50)[:, None]
    drives = {
        name: (t * [60.0, y, 0.0], 0.2 * np.sin(9 * t) * [1.0, 0.5, 0.0])
        for name, y in (("learned", 30.0), ("straight to goal", 0.0))
    }
    figure = plots.trajectories(ground(hills()), 0, drives, np.array([60.0, 0.0]), 8.0)
    overhead, roll, pitch = figure.axes
    lines = {line.get_label(): line.get_xydata() for line in overhead.lines}
    np.testing.assert_allclose(lines["learned"], drives["learned"][0][:, :2])
    assert len(roll.lines) == len(pitch.lines) == 2
    peak = np.degrees(np.abs(drives["learned"][1][:, 0]).max())
    assert np.abs(roll.lines[0].get_ydata()).max() == pytest.approx(peak)
    assert roll.lines[0].get_xdata()[-1] == pytest.approx(4.9)
    assert roll.lines[0].get_linestyle() != roll.lines[1].get_linestyle()
    figure.savefig(file := io.BytesIO())
    assert file.getvalue()[:4] == b"\x89PNG"
    (legend,) = figure.legends
    said = [text.get_text() for text in legend.get_texts()]
    assert said == [
        "learned",
        "straight to goal",
        "end of a drive",
        "start",
        "goal, in a circle of 8 m",
        "grass",
    ]
    assert overhead.get_title() == "world 0"


def test_risks_are_drawn_of_those_that_foretell_them():
    drives = {name: (np.zeros((9, 3)), np.zeros((9, 3))) for name in ("learned", "straight")}
    goal, risks = np.array([60.0, 0.0]), {"learned": np.linspace(0, 1, 9)}
    figure = plots.trajectories(ground(), 0, drives, goal, 8.0, risks)
    *_, roll, pitch, below = figure.axes
    (drawn,) = below.lines
    np.testing.assert_array_equal(drawn.get_ydata(), risks["learned"])
    assert drawn.get_color() == roll.lines[0].get_color()
    assert below.get_xlabel() and not pitch.get_xlabel()


def test_maps_are_shown_with_a_legend_of_their_ground():
    semantic = np.full((16, 16), GRASS)
    semantic[0, 0] = SNOW
    snowy = TerrainMap.from_array(hills(), semantic)
    figure = terrain_map.stack([ground(obstacles=[[0, 0, 4, 4, 2]]), snowy]).plot(["plain", "hill"])
    assert [axes.get_title() for axes in figure.axes] == ["plain", "hill"]
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert said == ["grass", "snow", "rock or tree"]


def test_learning_curves_draw_every_metric_of_every_run():
    runs = {
        f"seed {i}": {"step": np.arange(5), "success": i * np.arange(5), "loss": np.ones(5)}
        for i in range(3)
    }
    labels = {"success": "success rate", "loss": "value loss"}
    figure = plots.learning_curves(runs, "step", labels)
    assert [axes.get_title() for axes in figure.axes] == ["success rate", "value loss"]
    np.testing.assert_array_equal(figure.axes[0].lines[2].get_ydata(), 2 * np.arange(5))
    del runs["seed 1"]["loss"]
    figure = plots.learning_curves(runs, "step", labels)
    assert np.isnan(figure.axes[1].lines[1].get_ydata()).all()
    figure.savefig(io.BytesIO())
