"""Errors of missing memory are known as such, whoever raises them."""

import errno
import os

import pytest
import torch

from avmsf.errors import lacks_memory


def test_a_tensor_that_cannot_be_allocated_lacks_memory() -> None:
    with pytest.raises(RuntimeError) as caught:
        torch.empty(1 << 60, dtype=torch.uint8)
    assert lacks_memory(caught.value)


def test_the_cause_counts_where_a_library_hides_it() -> None:
    error = OSError("the library could not be found")
    assert not lacks_memory(error)
    error.__context__ = OSError("libllvmlite.so: failed to map segment from shared object")
    assert lacks_memory(error)


@pytest.mark.parametrize(
    ("error", "lacks"),
    [
        (MemoryError(), True),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), True),
        (OSError("libllvmlite.so: cannot allocate memory in static TLS block"), True),
        (OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)), True),
        (ImportError("No module named 'torch'"), False),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), False),
        (RuntimeError("shapes cannot be multiplied"), False),
        (RecursionError("maximum recursion depth exceeded"), False),
    ],
)
def test_other_errors_do_not(error: Exception, lacks: bool) -> None:
    assert lacks_memory(error) is lacks
