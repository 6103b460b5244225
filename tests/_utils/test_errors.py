"""What errors hold, the message that they compose of it, and which of them are of missing memory."""

import errno
import os

import pytest
import torch

from avmsf.errors import CaptureError, lacks_memory


def test_an_error_is_composed_of_its_attributes_and_keeps_them():
    error = CaptureError.expected("a number", 0.1 + 0.2, file="impacts.csv", row=3, name="x", advice="correct it")
    assert type(error) is CaptureError
    assert {**error.attributes, "file": str(error.file)} == {
        "file": "impacts.csv",
        "row": 3,
        "name": "x",
        "value": 0.1 + 0.2,
    }
    assert str(error) == "impacts.csv, row 3: expected a number, got 0.3; correct it"
    error = CaptureError.expected("a file", got="a folder", file="a.wav", name="file")
    assert str(error) == "a.wav: expected a file, got a folder"


def full() -> Exception:
    with pytest.raises(RuntimeError) as caught:
        torch.empty(1 << 60, dtype=torch.uint8)
    return caught.value


def hidden() -> OSError:
    """Return an error whose cause a library hides."""
    error = OSError("the library could not be found")
    error.__context__ = OSError("libllvmlite.so: failed to map segment from shared object")
    return error


@pytest.mark.parametrize(
    ("error", "lacks"),
    [
        (full(), True),
        (hidden(), True),
        (MemoryError(), True),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), True),
        (OSError("libllvmlite.so: cannot allocate memory in static TLS block"), True),
        (OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)), True),
        (ImportError("No module named 'torch'"), False),
        (OSError("the library could not be found"), False),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), False),
        (RuntimeError("shapes cannot be multiplied"), False),
        (RecursionError("maximum recursion depth exceeded"), False),
    ],
)
def test_errors_of_missing_memory_are_told_from_others(error: Exception, lacks: bool) -> None:
    assert lacks_memory(error) is lacks
