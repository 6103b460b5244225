"""Tensors of a file are those of its skeleton, by name, shape, type and finite numbers."""

import math
from pathlib import Path

import pytest
import torch

from avmsf._utils.headers import FileKind
from avmsf._utils.tensor_files import expect_tensors
from avmsf.errors import FieldFileError
from factories.raising import raises

KIND = FileKind("kind", "a file", "make it again", FieldFileError)
SKELETON = {
    "places": torch.empty(4, 3, dtype=torch.float64, device="meta"),
    "rows": torch.empty(4, dtype=torch.int64, device="meta"),
}
PLACES, ROWS = torch.zeros(4, 3, dtype=torch.float64), torch.zeros(4, dtype=torch.int64)


@pytest.mark.parametrize(
    ("tensors", "name", "value"),
    [
        ({"places": PLACES, "lines": ROWS}, "rows", [["rows"], ["lines"]]),
        ({"places": PLACES, "rows": ROWS, "lines": ROWS}, "lines", [[], ["lines"]]),
        ({"places": PLACES[:3], "rows": ROWS}, "places", "float64[3, 3]"),
        ({"places": PLACES.float(), "rows": ROWS}, "places", "float32[4, 3]"),
        ({"places": PLACES - math.inf, "rows": ROWS}, "places", (-math.inf, -math.inf)),
    ],
)
def test_the_tensor_at_fault_is_named(tensors: dict[str, torch.Tensor], name: str, value: object) -> None:
    expect_tensors({"places": PLACES, "rows": ROWS}, SKELETON, Path("x"), KIND)
    with raises(FieldFileError, file=Path("x"), name=name, value=value):
        expect_tensors(tensors, SKELETON, Path("x"), KIND)
