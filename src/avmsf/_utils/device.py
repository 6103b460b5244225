"""The device that tensors are computed on."""

import torch

from avmsf.errors import AvmsfError


def usable_device(name: str | torch.device | None, *, raising: type[AvmsfError]) -> torch.device:
    """Return a device on which tensors can be made; without a name the CUDA GPU where there is one, else the CPU.

    Raises `raising` for a name of none, and a GPU that is not there or has no memory left.
    """
    try:
        place = torch.device(name or ("cuda" if torch.cuda.is_available() else "cpu"))
        torch.empty(1, device=place)
    except (RuntimeError, AssertionError) as error:  # AssertionError: PyTorch was built without it
        raise raising(
            f"device = {name}: expected one that PyTorch can use here, such as cpu, or cuda with an NVIDIA GPU, its "
            f"driver and free memory; found {str(error).splitlines()[0] if str(error) else type(error).__name__}: "
            "choose cpu"
        ) from error
    return place
