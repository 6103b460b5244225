"""Tensors in safetensors files with one text."""

from collections.abc import Mapping
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


def expect_tensors(tensors: Mapping[str, Tensor], skeleton: Mapping[str, Tensor], path: Path, kind: FileKind) -> None:
    """Raise the kind's error unless these are tensors of a skeleton's names, shapes and types, of finite numbers.

    The skeleton's are on the device `meta`, where they take no memory.
    """
    missing, unexpected = sorted(skeleton.keys() - tensors.keys()), sorted(tensors.keys() - skeleton.keys())

    def error(wanted: str, got: str, name: str, value: Any) -> AvmsfError:
        return kind.error.expected(wanted, value, got=got, file=path, name=name, advice=kind.advice)

    if missing or unexpected:
        got = f"missing {', '.join(missing) or 'none'}; unexpected {', '.join(unexpected) or 'none'}"
        raise error(f"{len(skeleton)} tensors", got, (missing or unexpected)[0], [missing, unexpected])
    for name, tensor in tensors.items():
        wanted, found = (
            f"{str(each.dtype).removeprefix('torch.')}{list(each.shape)}" for each in (skeleton[name], tensor)
        )
        if wanted != found:
            raise error(f"{name} as {wanted}", found, name, found)
        if not bool(torch.isfinite(tensor).all()):
            low, high = (float(each) for each in tensor.aminmax())
            raise error(f"{name} to be finite", f"{low:.3g} to {high:.3g}", name, (low, high))
