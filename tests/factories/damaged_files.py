"""Random damage to files, each from a seed, and the readers and verbs that open them.

An input is good if it is read, or refused by the package's own error.
"""

import json
import os
import random
import re
import shutil
import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from safetensors.torch import load as from_bytes
from safetensors.torch import save as to_bytes

from avmsf.errors import AvmsfError
from avmsf.gaussians.ply import read_splats
from avmsf.mesh.textured_mesh import read_textured_mesh
from avmsf.photographs import read_sparse_points, read_views

from .valid_files import SURFACES
from .verbs import run_verb

_NUMBERS = (
    *(b"nan", b"inf", b"-1", b"0", b"1e308", b"-1e308", b"1e-320", b"1e19", b"9" * 25, b"9" * 400, b"9" * 5000),
    *(b"1.5", b""),
)
_WORDS = (*_NUMBERS, b"null", b"true", b'"x"', b"\x00", b"../../../etc/passwd", "\u202e".encode(), b"[" * 2000, b"{}")
_VALUES: tuple[Any, ...] = (
    float("nan"), float("inf"), -1, 0, 1, 2**31, 2**63, 10**30, 10**400, 1e308, 1e-320, 1e38, True, None, "", "x",
    "\x00", [], {}, [[]], [1e308] * 3, "../x", "/dev/zero",
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e-?\d+)?")


def damage_bytes(content: bytes, chance: random.Random) -> bytes:
    """Return a file's bytes with one to four random changes: cut, moved, repeated, overwritten by extreme numbers."""
    data = bytearray(content)
    for _ in range(chance.randint(1, 4)):
        # Headers are where damage does most.
        place = min(chance.randrange(len(data) + 1), chance.choice((chance.randrange(200), len(data))))
        end = min(place + chance.choice((1, 2, 4, 8, 64)), len(data))
        noise = chance.randbytes(end - place)
        extreme = chance.choice((b"\xff" * 4, b"\xff\xff\xff\x7f", bytes(4), struct.pack("<d", float("nan"))))
        data[place:end] = chance.choice((noise, b"", 2 * data[place:end], noise + data[place:end], extreme, extreme))
        if chance.random() < 0.05:
            del data[place:]
    return bytes(data)


def damage_text(content: bytes, chance: random.Random) -> bytes:
    """Return a text with one to three changes: a number replaced, a line cut, repeated or moved; or damaged bytes."""
    if chance.random() < 0.15:
        return damage_bytes(content, chance)
    for _ in range(chance.randint(1, 3)):
        if chance.random() < 0.4:
            lines = content.split(b"\n")
            row = chance.randrange(len(lines))
            lines[row : row + 1] = [lines[row]] * chance.choice((0, 0, 2, 50))
            content = b"\n".join(lines)
        else:
            place = chance.randrange(len(content) + 1)
            numbers = [found.span() for found in _NUMBER.finditer(content)]
            start, end = chance.choice([(place, place), chance.choice(numbers or [(place, place)])])
            content = content[:start] + chance.choice(_WORDS) + content[end:]
    return content


def damage_document(content: bytes, chance: random.Random) -> bytes:
    """Return JSON with one to three of its values replaced, removed or repeated; or damaged as any text."""
    if chance.random() < 0.3:
        return damage_text(content, chance)
    document = json.loads(content)
    for _ in range(chance.randint(1, 3)):
        # Values near the top as likely as those in long lists.
        if holders := [each for each in _holders(document) if each]:
            holder = chance.choice(holders[: chance.choice((1, 3, len(holders)))])
            key = chance.choice(list(holder)) if isinstance(holder, dict) else chance.randrange(len(holder))
            if chance.random() < 0.2:
                del holder[key]
            elif isinstance(holder, list) and chance.random() < 0.2:
                holder.extend([holder[key]] * 3)
            else:
                holder[key] = deepcopy(chance.choice(_VALUES))
    return json.dumps(document).encode()


def _holders(value: Any) -> list[Any]:
    """Return all dicts and lists in a document, the outer ones first."""
    if not isinstance(value, dict | list):
        return []
    inner = value.values() if isinstance(value, dict) else value
    return [value, *(each for one in inner for each in _holders(one))]


def _damage_field(content: bytes, chance: random.Random) -> bytes:
    """Damage the record in the header, or one tensor, or any bytes."""
    if chance.random() < 0.3:
        return damage_bytes(content, chance)
    size = int.from_bytes(content[:8], "little")
    metadata, tensors = json.loads(content[8 : 8 + size])["__metadata__"], from_bytes(content)
    if chance.random() < 0.3:
        flat = tensors[chance.choice(sorted(tensors))].flatten()
        flat[chance.randrange(len(flat))] = chance.choice((float("nan"), 1e38, -1e38, 0.0, -1.0, 1e-38))
    else:
        metadata["avmsf"] = damage_document(metadata["avmsf"].encode(), chance).decode(errors="replace")
    return to_bytes(tensors, metadata)


@dataclass(frozen=True)
class Family:
    """One kind of file: which seed is damaged, how, and what reads it."""

    seeds: tuple[str, ...]
    """Files below the folder of seeds."""
    damage: Callable[[bytes, random.Random], bytes]
    read: Callable[[Path, Path], Any]
    """Reads the damaged file in the copied folder of seeds; raises `AvmsfError` for a refusal."""


def _run(*words: str) -> None:
    """Run a verb in silence; raise AvmsfError for a refusal."""
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        code = run_verb(*words)
    # `check` refuses a capture by its code: its report says why.
    if code == 2:
        raise AvmsfError(" ".join(words))
    if code:
        raise RuntimeError(f"exit code {code}")


def _check(folder: Path, _: Path) -> None:
    _run("check", str(folder / "capture"))
    _run("modes", str(folder / "capture"), "--json")


def _surface(folder: Path, path: Path) -> None:
    shutil.copyfile(path, folder / "capture" / f"surface{path.suffix}")
    _run("check", str(folder / "capture"))
    read_textured_mesh(path)


def _views(folder: Path, path: Path) -> None:
    place = folder / path.relative_to(folder).parts[0]
    read_views(place, longest=64)
    read_sparse_points(place)


def _field(folder: Path, path: Path) -> None:
    _run("info", str(path))
    _run("render", str(path), "--position", "0.05", "0.05", "0.002", "--output", str(folder / "sounds"))


def _seeds(folder: str, *names: str) -> tuple[str, ...]:
    return tuple(f"{folder}/{name}" for name in names)


FAMILIES = {
    "wav": Family(_seeds("capture", "a.wav", "b.wav", "c.wav"), damage_bytes, _check),
    "csv": Family(("capture/impacts.csv",), damage_text, _check),
    "toml": Family(("capture/capture.toml",), damage_text, _check),
    "transforms": Family(("transforms/transforms.json",), damage_document, _views),
    "pictures": Family(
        _seeds("transforms", "images/0.png", "images/1.jpg", "images/2.webp", "masks/0.png"), damage_bytes, _views
    ),
    "colmap text": Family(_seeds("colmap", "cameras.txt", "images.txt", "points3D.txt"), damage_text, _views),
    "colmap binary": Family(_seeds("colmap_binary", "cameras.bin", "images.bin", "points3D.bin"), damage_bytes, _views),
    **{suffix[1:]: Family((f"surface{suffix}",), damage_bytes, _surface) for suffix in SURFACES},
    "ply text": Family(("surface_text.ply",), damage_text, _surface),
    "obj": Family(("surface.obj",), damage_text, _surface),
    "off": Family(("surface.off",), damage_text, _surface),
    "gltf": Family(("surface.gltf",), damage_document, _surface),
    "splats": Family(("splats.ply",), damage_bytes, lambda _, path: read_splats(path)),
    "field": Family(("attention.safetensors", "mixture.safetensors"), _damage_field, _field),
}


def damaged_inputs(
    seeds: Path, folder: Path, *, count: int, seed: int = 0, families: tuple[str, ...] = tuple(FAMILIES)
) -> Iterator[tuple[str, str, Callable[[], None]]]:
    """Yield `count` inputs of each family: its name, the input's, and what reads it; the files lie in `folder`."""
    for name in families:
        family = FAMILIES[name]
        for number in range(count):
            chance = random.Random(f"{name} {seed} {number}")
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(seeds, folder)
            path = folder / chance.choice(family.seeds)
            path.write_bytes(family.damage(path.read_bytes(), chance))
            yield name, f"{path.name} {number}", partial(family.read, folder, path)


def outcome_of(read: Callable[[], None]) -> tuple[str, str]:
    """Run what reads an input; return `read`, `refused` or `traceback` with the error's type and message."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read()
    except AvmsfError as error:
        return "refused", str(error)
    except (Exception, SystemExit) as error:  # whatever the reader lets through is what is looked for
        return "traceback", f"{type(error).__name__}: {error}"
    return "read", ""
