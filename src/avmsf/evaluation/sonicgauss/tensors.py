"""Named tensors of a file as a network expects them: all there, each of its shape."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from torch import Tensor

from avmsf.errors import EvaluationError


def expect_tensors(path: Path, tensors: Mapping[str, Tensor], shapes: Mapping[str, Sequence[int]]) -> None:
    """Raise EvaluationError, which names the first tensor that is missing or has another shape."""
    missing = [name for name in shapes if name not in tensors]
    if missing:
        raise EvaluationError(
            f"{path}: expected {len(shapes)} tensors, {missing[0]} among them, found none of that name, and none of "
            f"{len(missing) - 1} others: it holds another model or a part of one; copy the whole file again"
        )
    for name, shape in shapes.items():
        if tuple(tensors[name].shape) != tuple(shape):
            raise EvaluationError(
                f"{path}: expected the tensor {name} with the shape {tuple(shape)}, found "
                f"{tuple(tensors[name].shape)}: it belongs to another model"
            )
