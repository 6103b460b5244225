"""The device that tensors are computed on."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch

from avmsf.errors import AvmsfError

TRAINABLE = ("cpu", "cuda")
"""Kinds of devices that fields are trained on: others lack double precision or hold no values."""


def steps_between_losses(device: torch.device) -> int:
    """Return after how many steps a loss is read: reading one from a GPU waits for all that it was given."""
    return 1 if device.type == "cpu" else 50


@contextmanager
def without_denormals() -> Iterator[None]:
    """Take numbers below the least normal one for zero in this thread: processors take ten times as long for them."""
    # Torch has no function that says how it is set: a half of the least normal number does.
    before = sys.float_info.min / 2 == 0.0
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch and numba compute on one thread: sums in one order, and workers that do not stall each other."""
    import numba

    threads, kernels = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        numba.set_num_threads(kernels)


def usable_device(
    name: str | torch.device | None, *, raising: type[AvmsfError], kinds: Sequence[str] = ()
) -> torch.device:
    """Return a device on which tensors can be made; without a name the CUDA GPU where there is one, else the CPU.

    Raises `raising` for a name of none, for one that is not of `kinds` where these are given, and for a GPU that is not
    there or has no memory left.
    """
    wanted = name or ("cuda" if torch.cuda.is_available() else "cpu")
    usable, cause = kinds or TRAINABLE, None
    try:
        place = torch.device(wanted)
        if not kinds or place.type in kinds:
            torch.empty(1, device=place)
            return place
    except (RuntimeError, AssertionError) as error:  # AssertionError: PyTorch was built without it
        cause = error
    raise raising.expected(
        f"{' or '.join(usable)}, where cuda needs an NVIDIA GPU, its driver and free memory",
        str(wanted),
        name="device",
        advice="choose cpu",
    ) from cause
