"""Draws a scene as an animated GIF: the map from above, which follows the vehicle, over plots."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vertiwm_jax import atomic, figures
from vertiwm_jax.evaluation import plots
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain import picture
from vertiwm_jax.viewing.scene import FUSION, TILT, Scene, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

EVERY = 2
"""Steps from one frame to the next."""
REACH = np.array([18.0, 11.0])
"""m from the middle of the map's window to its sides, and to its upper and lower edge."""
MARGIN = 5.0
"""m from those at which the window moves on."""
DOTS = 80
"""An inch."""
COLORS = 128
"""Of all frames."""
_LABELS = {TILT: "angle [deg]", FUSION: "0 Transformer,\n1 NeSAM"}
"""Of the panels that are drawn."""
_DRIVEN, _PREDICTED = (figures.line(i)[0] for i in (0, 1))
_ABOVE: dict[str, Any] = {
    "loc": "lower left", "bbox_to_anchor": (0, 1), "ncols": 4, "borderaxespad": 0.2, "fontsize": 8
}  # fmt: skip

Show = Callable[[int], None]
"""Moves what is drawn to its place at a step."""


def write(scene: Scene, path: Path) -> None:
    """Writes the movie as a whole, or not at all; raises `WriteError`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    frames = []
    with figures.style():
        figure, show = draw(scene)
        canvas = FigureCanvasAgg(figure)
        for step in range(0, scene.steps + 1, EVERY):
            show(step)
            canvas.draw()
            frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    # One palette for all frames, so that pixels that do not change are not stored again.
    palette = Image.fromarray(np.concatenate([np.asarray(frame) for frame in frames[::8]]))
    palette = palette.quantize(COLORS, Image.Quantize.FASTOCTREE)
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    data, duration = io.BytesIO(), round(1000 * EVERY * STEP_SECONDS)
    first.save(data, "GIF", save_all=True, append_images=others, duration=duration, loop=0)
    atomic.write(path, data.getvalue())


def draw(scene: Scene) -> tuple[Figure, Show]:
    """The figure, and a function that moves everything in it to its place at a step."""
    strips = {title: lines for title, lines in panels(scene).items() if title in _LABELS}
    figure = figures.sheet(6.4, 4.4 + 1.15 * len(strips))
    figure.set_dpi(DOTS)
    overhead, *below = figure.subplots(1 + len(strips), 1, height_ratios=[4, *(1 for _ in strips)])
    move, present = _draw_map(overhead, scene), []
    for axes, (title, lines) in zip(below, strips.items(), strict=True):
        for i, (name, values) in enumerate(lines.items()):
            color, dash = figures.line(i)
            axes.plot(scene.seconds, values, dash, color=color, label=name)
        axes.set(ylabel=_LABELS[title], xlim=(0, scene.seconds[-1]))
        axes.legend(**_ABOVE)
        axes.tick_params(labelbottom=axes is below[-1])
        present.append(axes.axvline(0, color="black", linewidth=1))
    below[-1].set_xlabel("time [s]")
    figure.suptitle(scene.title)
    figure.align_ylabels()
    # A layout that was found anew for every frame would tremble.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")

    def show(step: int) -> None:
        move(step)
        for line in present:
            line.set_xdata([scene.seconds[step]] * 2)

    return figure, show


def _draw_map(axes: Axes, scene: Scene) -> Show:
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Rectangle
    from matplotlib.transforms import Affine2D

    vehicle, prediction = scene.vehicle, scene.prediction
    picture.draw_map(axes, scene.terrain, scene.world, "")
    if scene.goal is not None:
        plots.draw_goal(axes, scene.goal, scene.goal_radius)
    behind = axes.plot([], [], color="white", linewidth=4, alpha=0.8)[0]
    path = axes.plot([], [], color=_DRIVEN, linewidth=2, label="driven")[0]
    ahead = LineCollection([], colors=_PREDICTED, linestyles="--", linewidths=2, zorder=2)
    if prediction:
        ahead.set_label("predicted, 1.6 s at a time")
        axes.add_collection(ahead, autolim=False)

    def box(length: float, width: float, middle: float = 0.0, **style: Any) -> Patch:
        """A part of the vehicle, in its body frame."""
        corner = middle - length / 2, -width / 2
        return axes.add_patch(Rectangle(corner, length, width, zorder=3, **style))

    length, width = float(vehicle.length), float(vehicle.track - np.max(vehicle.wheel_width))
    tires = np.stack(np.broadcast_arrays(2 * vehicle.wheel_radius, vehicle.wheel_width, [0.0] * 4))
    wheels = [box(*tire, facecolor="black") for tire in tires[:2].T.tolist()]
    body = (
        box(length, width, facecolor=_DRIVEN, edgecolor="white"),
        box(0.4 * length, 0.8 * width, -0.05 * length, facecolor="white", alpha=0.7),
    )
    lines, _ = axes.get_legend_handles_labels()
    ground = picture.ground_legend(scene.terrain, [scene.world])
    axes.legend(handles=lines + ground, **_ABOVE | {"ncols": 3})
    middles = _middles(scene)

    def show(step: int) -> None:
        x, y, yaw = scene.state[step, [0, 1, 5]]
        pose = Affine2D().rotate(yaw).translate(x, y) + axes.transData
        for part in body:
            part.set_transform(pose)
        turned = zip(wheels, vehicle.wheel_position, scene.steering[step], strict=True)
        for wheel, at, turn in turned:
            wheel.set_transform(Affine2D().rotate(turn).translate(*at) + pose)
        for line in (behind, path):
            line.set_data(*scene.state[: step + 1, :2].T)
        if prediction:
            ahead.set_segments(list(prediction.state[prediction.start <= step, :, :2]))
        (west, south), (east, north) = middles[step] - REACH, middles[step] + REACH
        axes.set(xlim=(west, east), ylim=(south, north))

    show(0)
    return show


def _middles(scene: Scene) -> np.ndarray:
    """`[T + 1, 2]` the middle of the map's window at each step, m.

    It stays where it is until the vehicle comes near its edge: a GIF then holds only what moves.
    """
    west, east, south, north = picture.extent(scene.terrain)
    low, high = np.array([west, south]) + REACH, np.array([east, north]) - REACH
    middles = [np.clip(scene.state[0, :2], low, high)]
    for place in scene.state[1:, :2]:
        near = np.abs(place - middles[-1]) > REACH - MARGIN
        middles.append(np.clip(place, low, high) if near.any() else middles[-1])
    return np.stack(middles)
