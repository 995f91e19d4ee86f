"""Reads CSV and Parquet files: one row per time stamp, with columns named by the settings."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vertiwm_jax.errors import needs, refusing
from vertiwm_jax.importers.log import Log, converted
from vertiwm_jax.importers.settings import ImportSettings, Table
from vertiwm_jax.learning.schema import DataError

Columns = dict[str, np.ndarray]


def read(path: Path, settings: ImportSettings) -> list[Log]:
    """The drives of a CSV or Parquet file, in the order in which they begin.

    Raises `DataError` naming file, column and expectation.
    """
    table = settings.table
    if table is None:
        raise DataError(f"{path}: expected settings with a section `table` that names its columns")
    columns_of = _parquet_columns if path.suffix == ".parquet" else _csv_columns
    columns = columns_of(path, _names(table))
    if table.drive is None:
        return [_log(str(path), columns, table, settings)]
    drives = columns.pop(table.drive).astype(str)
    labels, first = np.unique(drives, return_index=True)
    logs = []
    for label in labels[np.argsort(first)]:
        own = {name: column[drives == label] for name, column in columns.items()}
        logs.append(_log(f"{path}: drive {label}", own, table, settings))
    return logs


def _csv_columns(path: Path, names: Sequence[str]) -> Columns:
    """Columns of a CSV file with a header line, as text."""
    cells = []
    with (
        refusing(lambda found: DataError(f"{path}: expected a CSV file in UTF-8: {found}")),
        path.open(newline="", encoding="utf-8-sig") as file,
    ):
        rows = csv.reader(file, skipinitialspace=True)
        head = next(rows, [])
        _check_head(path, names, head)
        places = [head.index(name) for name in names]
        for row in rows:
            if not any(cell.strip() for cell in row):
                continue
            if len(row) != len(head):
                raise DataError(
                    f"{path}: line {rows.line_num}: expected {len(head)} values as in the head, "
                    f"found {len(row)}"
                )
            cells.append([row[place] for place in places])
    if not cells:
        raise DataError(f"{path}: expected rows below the head, found none")
    return dict(zip(names, np.array(cells).T, strict=True))


def _parquet_columns(path: Path, names: Sequence[str]) -> Columns:
    """Columns of a Parquet file; needs pyarrow."""
    with needs("pyarrow", "logs", path):
        from pyarrow.parquet import ParquetFile
    with refusing(lambda found: DataError(f"{path}: expected a Parquet file: {found}")):
        file = ParquetFile(path)
        _check_head(path, names, file.schema_arrow.names)
        table = file.read(columns=list(names))
        return {name: table[name].to_numpy() for name in names}


def _names(table: Table) -> list[str]:
    """The names of all columns that are read."""
    groups = [(x,) if isinstance(x, str) else x for x in vars(table).values() if x]
    return list(dict.fromkeys(name for group in groups for name in group))


def _log(name: str, columns: Columns, table: Table, settings: ImportSettings) -> Log:
    numbers = {key: _numbers(name, key, column) for key, column in columns.items()}

    def stacked(names: Sequence[str]) -> np.ndarray:
        return np.stack([numbers[key] for key in names], axis=1)

    speed = numbers[table.speed]
    if table.brake is not None:
        speed = speed - numbers[table.brake]
    found = Log(
        time=numbers[table.time],
        position=stacked(table.position),
        attitude=stacked(table.quaternion or table.rpy or ()),
        velocity=stacked(table.velocity) if table.velocity else None,
        angular_velocity=stacked(table.angular_velocity) if table.angular_velocity else None,
        command_time=numbers[table.time],
        command=np.stack([speed, numbers[table.steering]], axis=1),
    )
    return converted(found, name, settings)


def _numbers(name: str, key: str, column: np.ndarray) -> np.ndarray:
    try:
        return column.astype(np.float64)
    except (ValueError, TypeError) as error:
        raise DataError(f"{name}: {key}: expected numbers: {error}") from None


def _check_head(path: Path, names: Sequence[str], head: Sequence[str]) -> None:
    missing = [name for name in names if name not in head]
    if missing:
        raise DataError(
            f"{path}: expected columns {', '.join(missing)}, found only {', '.join(head)}"
        )
