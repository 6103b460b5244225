"""NumPy files of known shape and type: checked by their headers, read only where they fit."""

from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np

from avmsf.errors import DatasetError


@dataclass(frozen=True)
class ArrayForm:
    """Type and shape that a file has to hold."""

    dtype: str
    """Such as `float64`."""
    shape: tuple[int | None, ...]
    """None for any length."""

    def __str__(self) -> str:
        lengths = ", ".join("any" if length is None else str(length) for length in self.shape)
        return f"{self.dtype} ({lengths}{',' * (len(self.shape) == 1)})"


def judge_array(path: Path, form: ArrayForm, *, shown: str) -> DatasetError | None:
    """Return the error of a file by its header and size alone, whose message calls it `shown`; or None."""
    if not path.is_file():
        return DatasetError(f"{shown}: expected a file, got none; download or unpack it again", file=path)
    try:
        with open(path, "rb") as file:
            version = np.lib.format.read_magic(file)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, column_major, dtype = read(file)
            start = file.tell()
            size = path.stat().st_size
    except (OSError, ValueError):
        return DatasetError(
            f"{shown}: expected a NumPy array, got other bytes; download it again", file=path, name="header"
        )
    fits = len(shape) == len(form.shape) and all(
        wanted in (None, length) for wanted, length in zip(form.shape, shape, strict=True)
    )
    if not fits or dtype != np.dtype(form.dtype):
        return DatasetError(
            f"{shown}: expected {form}, got {dtype} {shape}; take the published file of this dataset",
            file=path,
            name="shape",
            value=(str(dtype), *shape),
        )
    if column_major and len(shape) > 1:
        return DatasetError(
            f"{shown}: expected row-major order, got column-major; take the published file",
            file=path,
            name="order",
            value="F",
        )
    expected = start + prod(shape) * dtype.itemsize
    if size < expected:
        return DatasetError(
            f"{shown}: expected {expected} bytes, got {size}; download or unpack it again",
            file=path,
            name="size",
            value=size,
        )
    return None


def read_array(path: Path, form: ArrayForm, *, shown: str, lazily: bool = False) -> np.ndarray:
    """Return the array of a file; `lazily` maps it into memory, so that only the rows used are read.

    Raises the DatasetError of `judge_array`.
    """
    wrong = judge_array(path, form, shown=shown)
    if wrong is not None:
        raise wrong
    array: np.ndarray = np.load(path, mmap_mode="r" if lazily else None, allow_pickle=False)
    return array
