"""The trained weights of the `cdpam` package, read without running any of its code."""

import hashlib
import importlib.util
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import torch
from torch import Tensor

from avmsf.errors import EvaluationError

LAYERS = 16
"""Convolutions of the encoder."""
_FILE = Path("CDPAM_trained", "scratchJNDdefault_best_model.pth")
_INSTALL = "install them again: pip install --force-reinstall 'cdpam==0.0.6'"
_PLAIN = {
    ("torch._utils", "_rebuild_tensor_v2"),
    ("torch", "FloatStorage"),
    ("torch", "LongStorage"),
    ("collections", "OrderedDict"),
}
"""All that the file consists of besides numbers and strings."""


@dataclass(frozen=True, eq=False)
class CdpamWeights:
    """The authors' trained weights, by their names in their code."""

    tensors: Mapping[str, Tensor]
    digest: str
    """SHA-256 of the file, in hexadecimal."""

    def take(self, name: str, *shape: int) -> Tensor:
        """Return a tensor in float64. Raises EvaluationError where there is none of this name and shape."""
        tensor = self.tensors.get(name)
        if not isinstance(tensor, Tensor) or tuple(tensor.shape) != shape:
            found = list(tensor.shape) if isinstance(tensor, Tensor) else None
            raise EvaluationError(
                f"weights of the package cdpam: expected a tensor {name} of the shape {list(shape)}, got {found}; "
                f"{_INSTALL}",
                name=name,
                value=found,
            )
        return tensor.double()


def find_weights() -> Path:
    """Return where the installed package keeps its weights. Raises EvaluationError where it is not installed."""
    # Importing the package would fail: it needs modules that it does not install, and names that numpy has dropped.
    found = importlib.util.find_spec("cdpam")
    if found is None or not found.submodule_search_locations:
        raise EvaluationError.expected(
            "an installed package", name="cdpam", advice="pip install 'avmsf[eval]', or omit CDPAM with --no-cdpam"
        )
    return Path(found.submodule_search_locations[0]) / _FILE


def read_weights(path: Path) -> CdpamWeights:
    """Read a weights file. Raises EvaluationError where it is missing, damaged, or holds anything but tensors."""
    # The file is pickled the way of Python 2, with an opcode that torch's own `weights_only` does not know. So what may
    # be made while it is read is listed here, by the same principle.
    pickles = SimpleNamespace(__name__=__name__, Unpickler=_TensorUnpickler, load=_load)
    try:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            file.seek(0)
            stored = torch.load(file, map_location="cpu", weights_only=False, pickle_module=pickles)
    except (
        OSError,
        EOFError,
        RuntimeError,
        ValueError,
        KeyError,
        TypeError,
        IndexError,
        pickle.UnpicklingError,
    ) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise EvaluationError(
            f"{path}: expected the trained weights of CDPAM, got {reason}; {_INSTALL}", file=path
        ) from error
    tensors = stored.get("state") if isinstance(stored, Mapping) else None
    if not isinstance(tensors, Mapping):
        raise EvaluationError.expected(
            "the trained weights of CDPAM under 'state'", file=path, name="state", advice=_INSTALL
        )
    return CdpamWeights(tensors, digest)


class _TensorUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _PLAIN:
            raise pickle.UnpicklingError(f"{module}.{name} in place of tensors")
        return super().find_class(module, name)


def _load(file: IO[bytes], **options: Any) -> Any:
    return _TensorUnpickler(file, **options).load()
