"""The device that tensors are computed on."""

from collections.abc import Sequence

import torch

from avmsf.errors import AvmsfError

TRAINABLE = ("cpu", "cuda")
"""Kinds of devices that fields are trained on: others lack double precision or hold no values."""


def usable_device(
    name: str | torch.device | None, *, raising: type[AvmsfError], kinds: Sequence[str] = ()
) -> torch.device:
    """Return a device on which tensors can be made; without a name the CUDA GPU where there is one, else the CPU.

    Raises `raising` for a name of none, for one that is not of `kinds` where these are given, and for a GPU that is not
    there or has no memory left.
    """
    wanted = name or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        place = torch.device(wanted)
        if kinds and place.type not in kinds:
            raise RuntimeError(f"{place.type}; only {' or '.join(kinds)} is supported")
        torch.empty(1, device=place)
    except (RuntimeError, AssertionError) as error:  # AssertionError: PyTorch was built without it
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise raising(
            f"device: expected one that PyTorch can use, such as cpu, or cuda with an NVIDIA GPU, its driver and free "
            f"memory, got {wanted} ({reason}); choose cpu",
            name="device",
            value=str(wanted),
        ) from error
    return place
