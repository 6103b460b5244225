"""Arrays that users give, lists and numpy arrays among them, as tensors of a known shape."""

import math
import operator
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, SupportsIndex

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.errors import ArrayError, AvmsfError

ArrayLike = Tensor | np.ndarray | Sequence[Any]
"""A tensor, a numpy array, or nested lists of numbers."""
_LONGEST = 80
"""Characters of a single value."""


def as_vectors(
    values: ArrayLike, name: str, *, count: int | None = None, size: int | None = 3
) -> Float[Tensor, "rows size"]:
    """Return `size` numbers a row, any for None, as a tensor on the CPU: a float tensor's own type, else float64.

    Raises ArrayError for another shape, for another number of rows than `count`, and for values that are not finite.
    """
    found = as_floats(values, name)
    if found.ndim != 2 or size not in (None, found.shape[1]) or count not in (None, len(found)):
        rows, columns = "rows" if count is None else count, "columns" if size is None else size
        single = f"put a single one into a list, {name}=[[x, y, z]]" if found.shape == (size,) else ""
        raise ArrayError.expected(f"an array [{rows}, {columns}]", list(found.shape), name=name, advice=single)
    return _finite(found, name)


def as_directions(values: ArrayLike, name: str, *, count: int) -> Float[Tensor, "rows 3"]:
    """Return `count` vectors of length 1, or 0 where they are given so. Raises as `as_vectors`."""
    vectors = as_vectors(values, name, count=count)
    length = vectors.norm(dim=1, keepdim=True)
    # What has unit length already stays as it is, to the last bit.
    kept = ((length - 1.0).abs() < 1e-6) | (length == 0.0)
    return torch.where(kept, vectors, vectors / length)


def as_count(value: SupportsIndex, name: str, *, raising: type[AvmsfError] = ArrayError) -> int:
    """Return a whole number of 1 or more. Raises `raising` for another."""
    try:
        count = 0 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        # Arrays have __index__, but only those of one whole number give one.
        count = 0
    if count < 1:
        raise raising.expected("a whole number of 1 or more", value, name=name)
    return count


def as_forces(
    values: float | int | ArrayLike, name: str, *, count: int, positive: bool = False
) -> Float[Tensor, " rows"]:
    """Return `count` numbers of 0 or more, or one that holds for all, as a tensor of `count`. Raises as `as_vectors`.

    An impact pushes: a negative force would be a pull. What was recorded had one: `positive` refuses 0.
    """
    found = as_floats(values, name)
    if found.ndim > 1 or (found.ndim == 1 and len(found) != count):
        raise ArrayError.expected(f"one number or {count}", list(found.shape), name=name)
    forces = _finite(found.expand(count), name)
    if len(wrong := torch.nonzero(forces <= 0 if positive else forces < 0)):
        raise ArrayError.expected(
            "above 0" if positive else "0 or more", float(forces[wrong[0]]), name=name, row=int(wrong[0])
        )
    return forces


def as_samples(values: ArrayLike, name: str) -> Float[Tensor, " samples"]:
    """Return the samples of one channel. Raises ArrayError for another shape and what are no finite numbers."""
    found = as_floats(values, name)
    if found.ndim != 1:
        wanted, shape = "samples of one channel, in shape [samples]", list(found.shape)
        raise ArrayError.expected(wanted, shape, name=name, advice="give one channel")
    return _finite(found, name)


def as_floats(values: float | int | ArrayLike, name: str) -> Float[Tensor, "*shape"]:
    """Return numbers of any shape as floats on the CPU. Raises ArrayError for what are no numbers."""
    try:
        if isinstance(values, Tensor):
            found = values.clone()
        else:
            array = np.asarray(values)
            # A copy in native order: torch refuses reversed rows and foreign bytes, and shares others with the caller.
            found = torch.from_numpy(array.astype(array.dtype.newbyteorder("=")))
    except (ValueError, TypeError, RuntimeError) as error:
        got = "lists of different lengths or other values" if isinstance(values, Sequence) else repr(values)[:60]
        raise ArrayError.expected(
            "numbers in an array or nested lists of equal lengths", type(values).__name__, got=got, name=name
        ) from error
    if found.is_complex():
        raise ArrayError.expected("real numbers", str(found.dtype), name=name)
    kept = isinstance(values, Tensor) and found.is_floating_point()
    return found.detach().cpu() if kept else found.detach().cpu().double()


def as_rate(value: float | int, name: str = "sample_rate") -> float:
    """Return a sample rate, Hz. Raises ArrayError for what is no number above 0."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not 0.0 < float(value) < math.inf:
        raise ArrayError.expected("a number above 0, in hertz", value, name=name)
    return float(value)


def _finite(found: Tensor, name: str) -> Tensor:
    wrong = torch.nonzero(~torch.isfinite(found))
    if len(wrong):
        row, value = int(wrong[0, 0]), float(found[tuple(wrong[0].tolist())])
        raise ArrayError.expected("finite numbers", value, name=name, row=row)
    return found


Seed = int | torch.Generator | None
"""What decides chance: a number, a generator that goes on from where it is, or None for the number 0."""


def fibonacci_sphere(count: int) -> Float64[Tensor, "count 3"]:
    """Return unit vectors on a spherical Fibonacci lattice (Gonzalez, Mathematical Geosciences 42, 2010)."""
    row = torch.arange(count, dtype=torch.float64)
    height = 1.0 - (2.0 * row + 1.0) / count
    turn = row * math.pi * (3.0 - math.sqrt(5.0))
    flat = (1.0 - height.square()).sqrt()
    return torch.stack([flat * torch.cos(turn), flat * torch.sin(turn), height], dim=1)


def generator_of(seed: Seed) -> torch.Generator:
    """Return the generator of a seed."""
    return seed if isinstance(seed, torch.Generator) else torch.Generator().manual_seed(0 if seed is None else seed)


def short_repr(value: Any) -> str:
    """Return a dataclass's name and fields in one line, tensors by their type and shape. For use as `__repr__`."""
    shown = (f"{each.name}={_short(getattr(value, each.name))}" for each in fields(value) if each.repr)
    return f"{type(value).__name__}({', '.join(shown)})"


def _short(value: object) -> str:
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')}{list(value.shape)}"
    if isinstance(value, torch.nn.Module):
        return f"<{type(value).__name__}>"
    if isinstance(value, tuple | list | dict) and len(value) > 3:
        return f"<{len(value)} items>"
    text = repr(value)
    return text if len(text) <= _LONGEST else f"<{type(value).__name__}>"
