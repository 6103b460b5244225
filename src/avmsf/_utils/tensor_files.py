"""Tensors in safetensors files with one text."""

from collections.abc import Mapping
from copy import copy
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf._utils.headers import FileKind
from avmsf.errors import AvmsfError


def read_tensors(path: Path, kind: FileKind) -> tuple[str, dict[str, Tensor]]:
    """Return the text of a safetensors file, and its tensors.

    Raises the kind's error for a file that is missing, damaged or of another kind.
    """
    text = kind.read_text(path)
    try:
        with safe_open(path, framework="pt") as file:
            # Clones, for what the file maps into memory would change with it.
            return text, {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise kind.unreadable(path) from error


def write_tensors(path: Path, tensors: Mapping[str, Tensor], text: str, kind: FileKind) -> None:
    """Write a safetensors file, whole or not at all. Raises the kind's error."""
    # Safetensors refuses tensors that share memory.
    copies = {name: each.detach().cpu().clone(memory_format=torch.contiguous_format) for name, each in tensors.items()}
    write_whole(path, save(copies, {kind.key: text}), raising=kind.error)


class TensorReader:
    """Hands out the tensors of a file, each once, by their types and sizes. Raises the kind's error."""

    def __init__(self, tensors: Mapping[str, Tensor], path: Path, kind: FileKind) -> None:
        self._left, self._path, self._kind, self._prefix = dict(tensors), path, kind, ""

    def within(self, prefix: str) -> "TensorReader":
        """Return what hands out the tensors whose names begin with a prefix, by the rest of their names."""
        found = copy(self)
        found._prefix += prefix
        return found

    def __call__(self, name: str, *size: int, dtype: torch.dtype = torch.float64) -> Tensor:
        """Return a tensor, which must be there, of this type and size and of finite numbers."""
        name = self._prefix + name
        if name not in self._left:
            raise self._error(f"the tensor {name}", "none", name, None)
        tensor = self._left.pop(name)
        wanted, found = (
            f"{str(kind).removeprefix('torch.')}{list(shape)}"
            for kind, shape in ((dtype, size), (tensor.dtype, tensor.shape))
        )
        if wanted != found:
            raise self._error(f"{name} as {wanted}", found, name, found)
        if not bool(torch.isfinite(tensor).all()):
            low, high = (float(each) for each in tensor.aminmax())
            raise self._error(f"{name} to be finite", f"{low:.3g} to {high:.3g}", name, (low, high))
        return tensor

    def expect_end(self) -> None:
        """Raise the kind's error where there are tensors that nothing asked for."""
        if names := sorted(self._left):
            raise self._error("no other tensors", ", ".join(names), names[0], names)

    def _error(self, wanted: str, got: str, name: str, value: Any) -> AvmsfError:
        kind = self._kind
        return kind.error.expected(wanted, value, got=got, file=self._path, name=name, advice=kind.advice)
