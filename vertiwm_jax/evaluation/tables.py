"""Tables in Markdown and CSV, and the files that a test writes."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vertiwm_jax import atomic, figures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = Mapping[str, "str | float"]
"""A row of a table, by the names of its columns."""


def write(folder: Path, files: Mapping[str, str | Figure]) -> None:
    """Writes texts and figures, by file name, into a folder, which is made if there is none.

    Raises `WriteError`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        if isinstance(content, str):
            atomic.write(folder / name, content)
        else:
            figures.save(content, folder / name)


def markdown(rows: Sequence[Row]) -> str:
    """Rows with equal keys as a Markdown table with aligned columns; floats have three digits."""
    told = [[f"{x:.3g}" if isinstance(x, float) else f"{x}" for x in row.values()] for row in rows]
    cells = [list(rows[0]), *told]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    cells.insert(1, ["-" * width for width in widths])
    lines = (" | ".join(map(str.ljust, row, widths)) for row in cells)
    return "\n".join(f"| {line} |" for line in lines)


def csv_text(rows: Sequence[Row]) -> str:
    """Rows with equal keys as CSV, with a header line."""
    table = io.StringIO()
    writer = csv.DictWriter(table, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    return table.getvalue()
