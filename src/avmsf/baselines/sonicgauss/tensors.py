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
            f"{path}: expected {len(shapes)} tensors, {len(missing)} are missing such as {missing[0]}; copy the file "
            "again",
            file=path,
            name=missing[0],
        )
    for name, shape in shapes.items():
        if tuple(tensors[name].shape) != tuple(shape):
            raise EvaluationError(
                f"{path}: expected the tensor {name} of the shape {list(shape)}, got {list(tensors[name].shape)}; copy "
                "the file of this model",
                file=path,
                name=name,
                value=list(tensors[name].shape),
            )
