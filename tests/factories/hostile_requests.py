"""Requests to a studio that no page would send, each from a seed, and what comes of them."""

import http.client
import io
import json
import math
import random
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import soundfile

from avmsf.field.store import save

from .capture_folder import RATE, fill, ring
from .damaged_files import damage_bytes
from .made_fields import elastic, sounding

_BODY_BYTES = 1 << 18
_NUMBERS = (
    *("NaN", "Infinity", "1e400", "1e308", "-1e308", "5e-324", "0", "-0.0", "-1", "1e-3", "1e3", "999.9", "1.5"),
    *("40", "-40", "120", "-120", "9" * 400, "9" * 5000, "true", "null", '"2"', '"\\ud800"', "[]", "{}", "[[1]]"),
)
_NAMES = (
    *("bowl", "../x", "con", "a" * 300, "\u202egnp", "\u00e4" * 90, "x\0y", ".", "", "a/b", "C:\\x", "\ud800"),
    *("\x1b[2J", "ceramic", "steel", "wood", "STEEL", "cheese", "displacement", "acceleration", "paper"),
)
_PATHS = (
    *("", "manifest.json", "capture", "field.bin", "revisions/1/field.bin", "revisions/99/x", "page/main.js"),
    *("modules/x", "strikes/0.wav", "capture/strikes/a.wav", "capture/strikes/%00.wav", "capture/strikes/%ff"),
    *("object.glb", "jobs/x", "jobs/x/events", "page/%2e%2e/routes.py", "page/" + "a" * 5000, "%ed%a0%80", "undo"),
    *("edit", "save", "locate"),
)
_METHODS = ("GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE")
_FORMATS = (
    *(("WAV", "FLOAT"), ("WAV", "DOUBLE"), ("WAV", "PCM_16"), ("WAV", "PCM_U8"), ("FLAC", "PCM_16")),
    *(("OGG", "VORBIS"), ("AU", "DOUBLE"), ("W64", "FLOAT"), ("AIFF", "FLOAT")),
)


@dataclass(frozen=True)
class Request:
    """One request, under the studio's secret."""

    method: str
    path: str
    body: bytes | None = None
    headers: Mapping[str, str] = field(default_factory=dict)


class Fuzzer:
    """An endless, reproducible sequence of requests."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.base = 1
        """The field's revision, without which no edit counts."""

    def requests(self) -> Iterator[Request]:
        """Yield requests, one kind after another."""
        choose = self._choose
        while True:
            yield Request("POST", "edit", self._edit())
            yield Request("POST", choose(("locate", "capture/check")), self._recording())
            names = ("x", "y", "z", "nx", "ny", "nz", "newtons")
            query = "&".join(f"{name}={choose(('0.01', '-0.02', '0', choose(_NUMBERS)))}" for name in names)
            yield Request("POST", f"capture/strikes?{quote(query, safe='=&')}", self._recording())
            yield Request("PUT", "capture/strikes/a.wav", self._recording())
            words = choose(({"base": self.base}, {"base": self.base, "name": choose(_NAMES)}))
            yield Request("POST", choose(("save", "edit", "undo")), json.dumps(words).encode())
            size = int(self.random.integers(1, _BODY_BYTES))
            long = b'{"base":1,"law":"' + b"w" * size + b'"}'
            bodies = (b"[" * size, b'{"base":' * (size // 8), b"\xff" * size, long, b"")
            yield Request("POST", choose(("edit", "undo", "save", "lead?base=x")), choose(bodies))
            headers = {"if-match": choose(_NAMES[:3]), "last-event-id": choose(("1", "-1", "9" * 30, "x"))}
            yield Request(choose(_METHODS), choose(_PATHS), None, headers)

    def _choose(self, values: Any) -> Any:
        return values[int(self.random.integers(len(values)))]

    def _edit(self) -> bytes:
        """Return an edit, of members that are there or not, with hostile numbers and names."""

        def members(*names: str) -> list[str]:
            return [f"{json.dumps(name)}:{self._choose(_NUMBERS)}" for name in names if self._choose((True, False))]

        modes = (f"{{{','.join(members('mode', 'db', 'pitch', 'decay'))}}}" for _ in range(self._choose(range(8))))
        pitched = f'{{"mode":{self._choose(range(4))},"pitch":{self._choose(_NUMBERS)}}}'
        name, other = json.dumps(self._choose(_NAMES)), json.dumps(self._choose(_NAMES))
        parts = [f'"modes":[{self._choose((",".join(modes), pitched))}]', f'"law":{name}', f"{name}:1"]
        parts += [f'"material":{{"from":{name},"to":{other}}}']
        chosen = [part for part in parts if self._choose((True, False, False))]
        return (
            "{" + ",".join([f'"base":{self.base}', *members("size", "pitch", "decay", "brightness"), *chosen]) + "}"
        ).encode()

    def _recording(self) -> bytes:
        """Return a sound file, whole, of hostile samples, or damaged."""
        sound = ring(self._choose((1, 2, 30, 900, 4000)) / RATE)
        sound *= self._choose((1.0, 1.0, 1.0, 0.0, 1e-12, 1e16, 1e308, -1.0))
        sound[len(sound) // 2] = self._choose((*[sound[0]] * 27, math.nan, math.inf, 1e300))
        kind, subtype = self._choose(_FORMATS)
        if subtype not in ("FLOAT", "DOUBLE"):
            sound = np.clip(np.nan_to_num(sound), -1, 1)
        memory = io.BytesIO()
        with np.errstate(over="ignore"):
            channels = np.repeat(sound[:, None], self._choose((1, 1, 1, 2, 8)), axis=1)
            soundfile.write(memory, channels, RATE, subtype=subtype, format=kind)
        content = memory.getvalue()
        damaged = self._choose((True, False))
        return damage_bytes(content, random.Random(int(self.random.integers(1 << 30)))) if damaged else content


def fuzz(ask: Callable[[Request], tuple[int, bytes]], *, count: int, seed: int = 0) -> dict[str, float]:
    """Send so many requests and return what came of them.

    `server_errors` counts answers of 500 and above, `unanswered` requests whose connection broke; both must be 0.
    """
    fuzzer, found = Fuzzer(seed), {"inputs": float(count), "server_errors": 0.0, "unanswered": 0.0}
    longest = worst = 0.0
    for _, request in zip(range(count), fuzzer.requests(), strict=False):
        begun = time.perf_counter()
        try:
            status, content = ask(request)
        except (http.client.HTTPException, OSError):
            found["unanswered"] += 1
            continue
        worst = max(worst, time.perf_counter() - begun)
        found["server_errors"] += status >= 500
        if status >= 400:
            longest = max(longest, len(content))
        elif request.method == "POST":
            fuzzer.base = json.loads(content).get("revision", fuzzer.base)
    return found | {"worst_seconds": worst, "longest_refusal_bytes": float(longest)}


def write_object(folder: Path) -> Path:
    """Write a capture folder of three strikes and a field of five modes into it, and return the field's file."""
    made = sounding(elastic())
    contacts, names = made.gain_field.points[:3], ("a.wav", "b.wav", "c.wav")
    sounds = made.render(contacts).numpy()
    rows = [f"{name},{','.join(map(str, each.tolist()))}" for name, each in zip(names, contacts, strict=True)]
    fill(folder, rows=rows, replace=dict(zip(names, 0.5 * sounds / np.abs(sounds).max(), strict=True)))
    save(made, folder / "plate.safetensors")
    return folder / "plate.safetensors"
