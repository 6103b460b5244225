"""What an interrupted edit goes on from."""

import hashlib
import io
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from avmsf._utils.caching import source_digest
from avmsf.errors import EditError
from avmsf.field.soundfield import SoundField
from avmsf.files import write_whole


def asked(field: SoundField, contacts: Tensor, guide: dict[str, Any], settings: dict[str, Any]) -> dict[str, str]:
    """Return a digest of each thing that decides an edit's result, by what errors call it.

    `contacts` are places at which the field's gains are looked at; `guide` and `settings` plain values.
    """
    known = field.known(contacts)
    heard = [field.bank.frequency, field.bank.damping, field.phase, known.mean, field.gain_field.points]
    digest = hashlib.sha256(json.dumps([field.sample_rate, field.samples]).encode())
    for tensor in (*heard, *(each for each in (known.quadrature, known.damping) if each is not None)):
        digest.update(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    words = {"guide": guide, "settings": settings, "version of avmsf": [version("avmsf"), source_digest()]}
    plain = {name: json.dumps(each, sort_keys=True).encode() for name, each in words.items()}
    return {"field": digest.hexdigest(), **{name: hashlib.sha256(each).hexdigest() for name, each in plain.items()}}


def write_steering(path: Path, state: dict[str, Any]) -> None:
    """Write an edit's state: tensors, numbers, words and containers of these. Raises `EditError`."""
    # By way of memory: torch's own writer reports a full disk as a RuntimeError of its archive format.
    content = io.BytesIO()
    torch.save(state, content)
    write_whole(path, lambda place: place.write_bytes(content.getvalue()), raising=EditError)


def read_steering(path: Path, *, wanted: dict[str, str]) -> dict[str, Any] | None:
    """Return the state at `path`, None where there is none.

    Raises `EditError` for a file that is no checkpoint of an edit, and for one that was asked for with another field,
    guide or settings than `wanted`, named.
    """
    if not path.exists():
        return None
    try:
        state: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
        found = state["asked"]
        differing = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
    # torch.load raises whatever unpacking raises, in words that advise to trust the file.
    except Exception as error:
        raise EditError(
            f"{path}: expected the checkpoint of an edit, found something else or a part of one: delete it or name "
            "another"
        ) from error
    if differing:
        raise EditError(
            f"{path}: this checkpoint belongs to an edit with another {' and another '.join(differing)}: delete it to "
            "start anew, or repeat that edit's arguments to go on with it"
        )
    return state
