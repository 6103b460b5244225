"""What identifies an edit's checkpoint."""

import hashlib
import json
from importlib.metadata import version
from typing import Any

from torch import Tensor

from avmsf._utils.caching import source_digest
from avmsf.field.sound_field import SoundField


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
    words = {
        "guide": guide,
        "settings": settings,
        "version of avmsf": [version("avmsf"), source_digest("avmsf.editing.guided")],
    }
    plain = {name: json.dumps(each, sort_keys=True).encode() for name, each in words.items()}
    return {"field": digest.hexdigest(), **{name: hashlib.sha256(each).hexdigest() for name, each in plain.items()}}
