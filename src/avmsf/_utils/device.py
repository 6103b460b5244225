"""The device that tensors are computed on."""

import torch

from avmsf.errors import AvmsfError


def usable_device(name: str | torch.device | None, *, raising: type[AvmsfError]) -> torch.device:
    """Return the CPU or a CUDA GPU that can be used; without a name the GPU where there is one, else the CPU.

    Raises `raising` for any other name, and a GPU that is not there or has no memory left.
    """
    wanted = name or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        place = torch.device(wanted)
        if place.type not in ("cpu", "cuda"):
            raise RuntimeError(f"the kind {place.type}, which lacks what is computed here")
        torch.empty(1, device=place)
    except (RuntimeError, AssertionError) as error:  # AssertionError: PyTorch was built without it
        raise raising(
            f"device = {wanted}: expected cpu, or cuda where PyTorch can use an NVIDIA GPU, its "
            f"driver and free memory; found {str(error).splitlines()[0] if str(error) else type(error).__name__}: "
            "choose cpu"
        ) from error
    return place
