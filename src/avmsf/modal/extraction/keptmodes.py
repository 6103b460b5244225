"""Modes that are found once and kept in a file.

Linear algebra rounds differently from one run to the next, so modes that are found again differ in their last digits;
work that goes on after an interruption needs the very ones it began with.
"""

import hashlib
import json
from importlib.metadata import version
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from avmsf._utils.caching import keep_if_possible, source_digest
from avmsf.capture import Impacts
from avmsf.files import write_whole
from avmsf.modal.bank import Extraction, ModalBank
from avmsf.modal.extraction.extract import ModeFinder, extract, extract_sounds
from avmsf.modal.residual import Residual

_KEY = "avmsf-modes"


def extract_once(
    train: Impacts, method: ModeFinder, path: Path, *, lone: bool = False, needed: bool = False
) -> Extraction:
    """Return the modes that `path` keeps of these recordings and this method; find and keep them where it has none.

    With `lone`, one recording is enough. Where the file cannot be written, the modes are found again next time; it is
    an error if the file is `needed`. Raises as `extract`, and FieldFileError.
    """
    digest = _digest(train, method)
    kept = _read(path, digest)
    if kept is not None:
        return kept
    if lone and len(train) == 1:
        found = extract_sounds(train.sounds, sample_rate=train.sample_rate, method=method)
    else:
        found = extract(train, method)
    tensors = {
        "frequency": found.bank.frequency,
        "damping": found.bank.damping,
        "gains": found.gains,
        "quadrature": found.quadrature,
        "residual": found.residual.magnitude,
    }
    content = save({name: tensor.contiguous() for name, tensor in tensors.items()}, {_KEY: digest})

    def write() -> None:
        write_whole(path, lambda place: place.write_bytes(content))

    if needed:
        write()
    else:
        keep_if_possible(write, path)
    return found


def _read(path: Path, digest: str) -> Extraction | None:
    try:
        with safe_open(path, framework="pt") as file:
            if (file.metadata() or {}).get(_KEY) != digest:
                return None
            # Clones, for what the file maps into memory goes with it.
            read = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError):
        return None
    return Extraction(
        ModalBank(read["frequency"], read["damping"]), read["gains"], Residual(read["residual"]), read["quadrature"]
    )


def _digest(train: Impacts, method: ModeFinder) -> str:
    words = [version("avmsf"), source_digest(), repr(method), train.names, train.sample_rate]
    digest = hashlib.sha256(json.dumps(words).encode())
    digest.update(train.sounds.contiguous().numpy().tobytes())
    return digest.hexdigest()
