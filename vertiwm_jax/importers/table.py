"""Reads CSV and Parquet files: one row per time stamp, with columns named by the settings."""

import csv
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from vertiwm_jax.errors import needs, refusing
from vertiwm_jax.importers.log import Log, converted
from vertiwm_jax.importers.settings import ImportSettings, Table
from vertiwm_jax.learning.schema import DataError

Columns = dict[str, np.ndarray]


def read(path: Path, settings: ImportSettings) -> list[Log]:
    """The drives of a CSV or Parquet file, in the order in which they begin.

    Drives that cannot be used are left out. Raises `DataError` naming file, column and expectation
    where they are more than half.
    """
    table = settings.table
    if table is None:
        raise DataError(f"{path}: expected settings with a section `table` that names its columns")
    columns_of = _parquet_columns if path.suffix == ".parquet" else _csv_columns
    columns, remarks = columns_of(path, _names(table))
    stamps = columns[table.time]
    if stamps.dtype.kind == "M":  # Dates, which have a unit of their own.
        nanoseconds = stamps.astype("datetime64[ns]").astype(np.int64)
        seconds = np.where(np.isnat(stamps), np.nan, 1e-9 * nanoseconds)
        columns[table.time] = seconds / settings.units.time
    if table.drive is None:
        return converted(_log(str(path), columns, table), path, settings, remarks.items())
    drives = columns.pop(table.drive).astype(str)
    labels, first = np.unique(drives, return_index=True)
    logs = []
    refused = 0
    for label in labels[np.argsort(first)]:
        own = {name: column[drives == label] for name, column in columns.items()}
        name = f"{path}: drive {label}"
        try:
            logs += converted(_log(name, own, table), name, settings)
        except DataError as error:
            refused += 1
            if 2 * refused > len(labels):
                raise
            remarks[str(error)] = int((drives == label).sum())
    return [replace(logs[0], remarks=remarks | logs[0].remarks), *logs[1:]]


def _csv_columns(path: Path, names: Sequence[str]) -> tuple[Columns, dict[str, int]]:
    """Columns of a CSV file with a header line, as text, and what is said of its other lines.

    Commas, semicolons or tabs separate values: what the header line has most of.
    """
    cells, others = [], []
    with (
        refusing(lambda found: DataError(f"{path}: expected a CSV file in UTF-8: {found}")),
        path.open(newline="", encoding="utf-8-sig") as file,
    ):
        first = file.readline()
        separator = max(",;\t", key=first.count)
        rows = csv.reader(chain([first], file), delimiter=separator, skipinitialspace=True)
        head = next(rows, [])
        _check_head(path, names, head)
        places = [head.index(name) for name in names]
        for row in rows:
            if not any(cell.strip() for cell in row):
                continue
            if len(row) == len(head):
                cells.append([row[place] for place in places])
            else:
                others.append(
                    f"{path}: line {rows.line_num}: expected {len(head)} values as in the head, "
                    f"found {len(row)}"
                )
    if len(others) > len(cells):
        raise DataError(f"{others[0]}; {len(others)} such")
    if not cells:
        raise DataError(f"{path}: expected rows below the head, found none")
    remarks = {f"{others[0]}: left out {len(others)} such lines": len(others)} if others else {}
    return dict(zip(names, np.array(cells).T, strict=True)), remarks


def _parquet_columns(path: Path, names: Sequence[str]) -> tuple[Columns, dict[str, int]]:
    """Columns of a Parquet file, of which nothing is left out; needs pyarrow."""
    with needs("pyarrow", "logs", path):
        from pyarrow.parquet import ParquetFile
    with refusing(lambda found: DataError(f"{path}: expected a Parquet file: {found}")):
        file = ParquetFile(path)
        _check_head(path, names, file.schema_arrow.names)
        table = file.read(columns=list(names))
        return {name: table[name].to_numpy() for name in names}, {}


def _names(table: Table) -> list[str]:
    """The names of all columns that are read."""
    groups = [(x,) if isinstance(x, str) else x for x in vars(table).values() if x]
    return list(dict.fromkeys(name for group in groups for name in group))


def _log(name: str, columns: Columns, table: Table) -> Log:
    numbers = {key: _numbers(name, key, column) for key, column in columns.items()}

    def stacked(names: Sequence[str]) -> np.ndarray:
        return np.stack([numbers[key] for key in names], axis=1)

    time = numbers[table.time]
    level = np.zeros((len(time), 2))
    position = stacked(table.position)
    if table.yaw:
        position = np.column_stack([position, level[:, 0]])
        attitude = np.column_stack([level, numbers[table.yaw]])
    else:
        attitude = stacked(table.quaternion or table.rpy or ())
    if table.left and table.right:
        kind, first, second = "wheels", table.left, table.right
    else:
        kind = "yaw_rate" if table.yaw_rate else "steering"
        first, second = table.speed or "", table.steering or table.yaw_rate or ""
    command = stacked([first, second])
    if table.brake is not None:
        command[:, 0] -= numbers[table.brake]
    return Log(
        time=time,
        position=position,
        attitude=attitude,
        velocity=stacked(table.velocity) if table.velocity else None,
        angular_velocity=stacked(table.angular_velocity) if table.angular_velocity else None,
        command_time=time,
        command=command,
        kind=kind,
    )


def _numbers(name: str, key: str, column: np.ndarray) -> np.ndarray:
    """A column as numbers, NaN where it holds something else; `DataError` if that is usual."""
    try:
        return column.astype(np.float64)
    except (ValueError, TypeError) as error:
        numbers = np.array([_number(cell) for cell in column])
        if 2 * np.isnan(numbers).sum() > len(numbers):
            raise DataError(f"{name}: {key}: expected numbers: {error}") from None
        return numbers


def _number(cell: Any) -> float:
    try:
        return float(cell)
    except (ValueError, TypeError):
        return np.nan


def _check_head(path: Path, names: Sequence[str], head: Sequence[str]) -> None:
    missing = [name for name in names if name not in head]
    if missing:
        raise DataError(
            f"{path}: expected columns {', '.join(missing)}, found only {', '.join(head)}"
        )
