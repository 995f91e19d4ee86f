import io

import jax.numpy as jnp
import numpy as np

from vertiwm_jax.evaluation import prediction_report
from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.evaluation.prediction_report import AROUND
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain.map import TerrainMap

CONTEXT, HORIZON = 2, 16


def test_coefficients_are_aligned_where_the_vehicle_crosses_a_border():
    semantic = np.full((16, 16), 3)
    semantic[:, 8:] = terrain_map.STANDARD.names.index("mud")  # east of x = 0
    terrain = TerrainMap.from_array(np.zeros((65, 65)), semantic)
    # Four windows at 1 m a step: onto soil in the sixth and in the tenth step, off it in the
    # eighth, and never.
    x = jnp.arange(-CONTEXT, HORIZON + 1.0)
    ahead = jnp.array([1, 1, -1, 1])[:, None] * x + jnp.array([-5.5, -9.5, 7.5, -25.0])[:, None]
    state = jnp.zeros((4, CONTEXT + HORIZON + 1, 12)).at[..., 0].set(ahead)
    control = jnp.zeros((4, CONTEXT + HORIZON, 2))
    kinds = jnp.zeros(4, jnp.int32)
    windows = Windows(state, control, kinds, kinds, CONTEXT)
    # Each coefficient tells its step.
    steps = np.broadcast_to(np.arange(HORIZON)[:, None], (4, HORIZON, 1)).astype(float)
    test = TestWindows(windows, np.arange(4), terrain)
    found = prediction_report.crossings(test, steps)
    assert set(found) == {"onto soil (2 windows)", "off soil (1 windows)"}
    onto, off = found["onto soil (2 windows)"][:, 0], found["off soil (1 windows)"][:, 0]
    assert onto[AROUND] == (5 + 9) / 2
    assert off[AROUND] == 7
    # Five steps before, both windows are inside; earlier, only the one that crosses later.
    assert onto[AROUND - 5] == (0 + 4) / 2 and onto[AROUND - 6] == 3
    assert np.isnan(off[0]) and off[-1] == 15


def test_pictures_of_predictions():
    # 10 m along y, and then to the left of that, from a vehicle that heads along y.
    path, start = np.array([[3.0, 4.0], [3.0, 14.0], [1.0, 14.0]]), np.zeros(12)
    start[[0, 1, 5]] = 3.0, 4.0, np.pi / 2
    recorded = prediction_report.ahead(start, path)
    windows = {f"window {i}": {"recorded": recorded, "model": recorded} for i in range(5)}
    figure = prediction_report.paths(windows)
    drawn = figure.axes[0].lines[0].get_xydata()
    np.testing.assert_allclose(drawn, [[0, 0], [0, 10], [-2, 10]], atol=1e-12)
    assert [axes.axison for axes in figure.axes] == [True] * 5 + [False] * 3
    figure.savefig(io.BytesIO())

    trace = np.array([[0.5, 0.1, 0.0, 0.0], [np.nan, 0.2, 0.0, 0.0], [0.7, 0.3, 0.0, 0.0]])
    figure = prediction_report.coefficients({"onto soil": trace})
    line = figure.axes[0].lines[1].get_xydata()
    np.testing.assert_allclose(line, [[-0.1, 0.1], [0.0, 0.2], [0.1, 0.3]])
    figure.savefig(io.BytesIO())
