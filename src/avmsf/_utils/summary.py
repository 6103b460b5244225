"""Short descriptions of values that hold arrays."""

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

_LONGEST = 80
"""Characters of a single value."""


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
