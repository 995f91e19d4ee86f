"""Draws a scene as a movie: the map from above, which follows the vehicle, and time series."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vertiwm_jax import atomic, figures
from vertiwm_jax.config import ConfigError
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain import picture
from vertiwm_jax.viewing.scene import FUSION, TILT, Scene, panels

if TYPE_CHECKING:
    from matplotlib.animation import AbstractMovieWriter
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

EVERY = 2
"""Steps from one frame to the next."""
REACH = np.array([18.0, 11.0])
"""m from the middle of the map's window to its sides, and to its upper and lower edge."""
MARGIN = 5.0
"""m from those at which the window moves on."""
DOTS = 80
"""An inch."""
COLOURS = 56
"""Of all frames of a GIF, besides those of lines."""
_LABELS = {TILT: "angle [deg]", FUSION: "0 Transformer,\n1 NeSAM"}
"""Of the panels that are drawn."""
_DRIVEN, _PREDICTED = (figures.line(i)[0] for i in (0, 1))
_RECTANGLE = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)]) / 2

Show = Callable[[int], None]


def check(path: Path) -> None:
    """Raises `ConfigError` if the package that writes such a movie is missing."""
    WRITERS[path.suffix](path)


def write(scene: Scene, path: Path) -> None:
    """Writes the movie as a whole, or not at all; raises like `check`, and `WriteError`."""
    from matplotlib.animation import FuncAnimation

    writer = WRITERS[path.suffix](path)
    with figures.style(), atomic.new_content(path) as unfinished:
        figure, show = draw(scene)

        def frame(step: int) -> list:
            show(step)
            return []

        steps = range(0, scene.steps + 1, EVERY)
        FuncAnimation(figure, frame, steps, init_func=list).save(unfinished, writer, dpi=DOTS)


def draw(scene: Scene) -> tuple[Figure, Show]:
    """The figure, and a function that moves everything in it to its place at a step."""
    strips = {name: lines for name, lines in panels(scene).items() if name in _LABELS}
    figure = figures.sheet(6.4, 4.2 + 1.15 * len(strips))
    overhead, *below = figure.subplots(1 + len(strips), 1, height_ratios=[4, *(1 for _ in strips)])
    moving = [_draw_map(overhead, scene)]
    for axes, (title, lines) in zip(below, strips.items(), strict=True):
        moving.append(_draw_strip(axes, scene, _LABELS[title], lines))
        axes.tick_params(labelbottom=axes is below[-1])
    below[-1].set_xlabel("time [s]")
    figure.suptitle(scene.title)
    figure.align_ylabels()
    # A layout that was found anew for every frame would tremble.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")

    def show(step: int) -> None:
        for part in moving:
            part(step)

    return figure, show


def _draw_map(axes: Axes, scene: Scene) -> Show:
    from matplotlib.patches import Circle, Polygon

    terrain, vehicle, prediction = scene.terrain, scene.vehicle, scene.prediction
    extent = picture.extent(terrain)
    axes.imshow(picture.shaded(terrain, scene.world), extent=extent, interpolation="nearest")
    axes.grid(False)
    axes.set(xlabel="x [m], east", ylabel="y [m], north")
    if scene.goal is not None:
        x, y = scene.goal[:2]
        axes.add_patch(Circle((x, y), scene.goal_radius, fill=False, linewidth=1.2))
        axes.plot(x, y, "*", color="black", markersize=11, markeredgecolor="white", label="goal")
    behind = axes.plot([], [], color="white", linewidth=4, alpha=0.8)[0]
    path = axes.plot([], [], color=_DRIVEN, linewidth=2, label="driven")[0]
    ahead = axes.plot([], [], "--", color=_PREDICTED, linewidth=2)[0]
    length, width = float(vehicle.length), float(vehicle.track - vehicle.wheel_width)
    tyre = 2 * float(vehicle.wheel_radius), float(vehicle.wheel_width)
    wheels = [Polygon(_RECTANGLE, facecolor="black") for _ in range(4)]
    body = Polygon(_RECTANGLE, facecolor=_DRIVEN, edgecolor="white", linewidth=1)
    cabin = Polygon(_RECTANGLE, facecolor="white", alpha=0.7)
    for patch in (*wheels, body, cabin):
        axes.add_patch(patch).set_zorder(3)
    if prediction:
        ahead.set_label("predicted, 1.6 s at a time")
    _legend_above(axes)
    middles = _middles(scene)

    def show(step: int) -> None:
        place, yaw = scene.state[step, :2], scene.state[step, 5]

        def put(patch: Polygon, middle: tuple[float, float], size: tuple[float, float], turn=0.0):
            corners = middle + _turned(_RECTANGLE * size, turn)
            patch.set_xy(place + _turned(corners, yaw))

        put(body, (0, 0), (length, width))
        put(cabin, (-0.05 * length, 0), (0.4 * length, 0.8 * width))
        for wheel, at, turn in zip(
            wheels, vehicle.wheel_position, scene.steering[step], strict=True
        ):
            put(wheel, tuple(at), tyre, turn)
        for line in (behind, path):
            line.set_data(*scene.state[: step + 1, :2].T)
        if prediction:
            made = prediction.state[prediction.start <= step, :, :2]
            # Gaps, where one ends and the next begins.
            gaps = np.full((len(made), 1, 2), np.nan)
            ahead.set_data(*np.concatenate([made, gaps], axis=1).reshape(-1, 2).T)
        (west, east), (south, north) = zip(
            middles[step] - REACH, middles[step] + REACH, strict=True
        )
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


def _draw_strip(axes: Axes, scene: Scene, label: str, lines: dict[str, np.ndarray]) -> Show:
    for i, (name, values) in enumerate(lines.items()):
        colour, dash = figures.line(i)
        axes.plot(scene.seconds, values, dash, color=colour, label=name)
    axes.set_ylabel(label)
    _legend_above(axes)
    axes.set_xlim(0, scene.seconds[-1])
    present = axes.axvline(0, color="black", linewidth=1)

    def show(step: int) -> None:
        present.set_xdata([scene.seconds[step]] * 2)

    return show


def _legend_above(axes: Axes) -> None:
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=4, borderaxespad=0.2)


def _turned(points: np.ndarray, angle: float) -> np.ndarray:
    """Points `[..., 2]` rotated to the left by `angle`, rad."""
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([(cos, sin), (-sin, cos)])


def _gif(path: Path) -> AbstractMovieWriter:
    from matplotlib.animation import PillowWriter
    from PIL import Image

    class OnePalette(PillowWriter):
        """Writes GIFs with one palette, so that pixels that do not change are not stored again."""

        def finish(self) -> None:
            some = self._frames[:: max(1, len(self._frames) // 8)]
            sheet = Image.fromarray(np.concatenate([np.asarray(frame) for frame in some]))
            palette, plain = sheet.quantize(COLOURS), Image.Dither.NONE
            lines = b"".join(bytes.fromhex(figures.line(i)[0][1:]) for i in range(7)) + b"\xff" * 3
            palette.putpalette((palette.getpalette() or [])[: 3 * COLOURS] + list(lines))
            self._frames = [frame.quantize(palette=palette, dither=plain) for frame in self._frames]
            super().finish()

    return OnePalette(fps=_FPS)


def _mp4(path: Path) -> AbstractMovieWriter:
    import matplotlib
    from matplotlib.animation import FFMpegWriter

    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError as error:
        raise ConfigError(
            f"{path}: expected the package imageio-ffmpeg to write it, found: {error}; "
            'pip install "vertiwm-jax[view]", or write a .gif'
        ) from None
    matplotlib.rcParams["animation.ffmpeg_path"] = get_ffmpeg_exe()
    return FFMpegWriter(fps=_FPS)


_FPS = round(1 / (EVERY * STEP_SECONDS))
WRITERS = {".gif": _gif, ".mp4": _mp4}
"""What makes the writer of a movie, by the ending of its file."""
