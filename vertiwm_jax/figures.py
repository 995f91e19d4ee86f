"""Style, colors and files of all figures. Matplotlib is imported with the first figure."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vertiwm_jax import atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito (2008), without the yellow that vanishes on paper; dashes tell the rest.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
_DASHES = ("-", "--", "-.", ":")
_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "0.88",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "savefig.dpi": 160,
}


def save(figure: Figure, path: str | Path) -> None:
    """Writes a figure in the format of its ending, whole or not at all; raises `WriteError`."""
    image = io.BytesIO()
    with style():
        figure.savefig(image, format=Path(path).suffix[1:])
    atomic.write(path, image.getvalue())


def line(i: int) -> tuple[str, str]:
    """Color and dash of the i-th line of a plot."""
    return _COLORS[i % len(_COLORS)], _DASHES[i % len(_DASHES)]


def style():
    """A context with the style of all plots."""
    import matplotlib

    return matplotlib.rc_context(_STYLE)


def sheet(width: float, height: float) -> Figure:
    """An empty figure of this size in inches."""
    from matplotlib.figure import Figure

    # Not made by pyplot: belongs to no window and is freed with its last reference.
    return Figure(figsize=(width, height), layout="constrained")
