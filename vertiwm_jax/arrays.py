"""Reads the arrays of NumPy's files, once it is known how large they are."""

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

MOST_BYTES = 10**9
"""Of an array, and of all that are read from an archive."""
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def load(path: Path) -> np.ndarray:
    """The array of a `.npy` file; `ValueError` where it is no plain one, or too large."""
    with path.open("rb") as file:
        return _array(file, MOST_BYTES)


def load_archive(path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """The arrays of these names that an `.npz` file has; `ValueError` as of `load`."""
    found, left = dict[str, np.ndarray](), MOST_BYTES
    with zipfile.ZipFile(path) as archive:
        held = set(archive.namelist())
        for name in names:
            if f"{name}.npy" in held:
                with archive.open(f"{name}.npy") as file:
                    found[name] = _array(file, left)
                left -= found[name].nbytes
    return found


def _array(file: IO[bytes], most: int) -> np.ndarray:
    version = npy.read_magic(file)
    if version not in _HEADERS:
        raise ValueError(f"expected an array in version 1 or 2 of NumPy's format, found {version}")
    shape, _, dtype = _HEADERS[version](file)
    if dtype.kind not in "biufSU":
        raise ValueError(f"expected numbers or text, found {dtype}")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize > most:
        size = " x ".join(map(str, shape))
        raise ValueError(f"expected at most {most / 1e6:,.0f} MB, found {size} of {dtype}")
    file.seek(0)
    return npy.read_array(file, allow_pickle=False)
