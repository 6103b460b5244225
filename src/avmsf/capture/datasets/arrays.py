"""NumPy files whose shape and type are known beforehand: judged by their headers, read only where they fit."""

from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np

from avmsf.errors import DatasetError


@dataclass(frozen=True)
class ArrayForm:
    """What a file has to hold."""

    dtype: str
    """Such as `float64`."""
    shape: tuple[int | None, ...]
    """None where any length will do."""

    def __str__(self) -> str:
        lengths = ", ".join("any" if length is None else str(length) for length in self.shape)
        return f"{self.dtype} ({lengths}{',' * (len(self.shape) == 1)})"


def judge_array(path: Path, form: ArrayForm, *, shown: str) -> str | None:
    """Return what is wrong with a file, by its header and size alone, in a sentence that calls it `shown`; or None."""
    if not path.is_file():
        return f"{shown} is missing"
    try:
        with open(path, "rb") as file:
            version = np.lib.format.read_magic(file)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, column_major, dtype = read(file)
            start = file.tell()
            size = path.stat().st_size
    except (OSError, ValueError) as error:
        return f"{shown} is no NumPy array ({error}): download it again"
    fits = len(shape) == len(form.shape) and all(
        wanted in (None, length) for wanted, length in zip(form.shape, shape, strict=True)
    )
    if not fits or dtype != np.dtype(form.dtype):
        return f"{shown} holds {dtype} {shape}, expected {form}: it is another dataset's, or was converted"
    if column_major and len(shape) > 1:
        return f"{shown} is stored by columns, expected by rows: it was converted; take the published file"
    expected = start + prod(shape) * dtype.itemsize
    if size < expected:
        return f"{shown} is cut short, {size} of {expected} bytes: download or unpack it again"
    return None


def read_array(path: Path, form: ArrayForm, *, shown: str, lazily: bool = False) -> np.ndarray:
    """Return the array of a file; `lazily` maps it into memory, so that only what is looked at is read.

    Raises DatasetError for what `judge_array` finds wrong.
    """
    wrong = judge_array(path, form, shown=shown)
    if wrong is not None:
        raise DatasetError(wrong)
    array: np.ndarray = np.load(path, mmap_mode="r" if lazily else None, allow_pickle=False)
    return array
