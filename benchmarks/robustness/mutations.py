"""Random damage to files, each from a seed: bytes, words of a text, values of a JSON document."""

import json
import random
import re
import struct
from copy import deepcopy
from typing import Any

_NUMBERS = (
    b"nan",
    b"inf",
    b"-1",
    b"0",
    b"1e308",
    b"-1e308",
    b"1e-320",
    b"1e19",
    b"9" * 25,
    b"9" * 400,
    b"9" * 5000,
    b"1.5",
    b"",
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
        place = chance.randrange(len(data) + 1)
        # Headers are where damage does most.
        if chance.random() < 0.5:
            place = min(place, chance.randrange(200))
        length = min(chance.choice((1, 2, 4, 8, 64)), len(data) - place)
        match chance.randrange(6):
            case 0:
                data[place : place + length] = chance.randbytes(length)
            case 1:
                del data[place : place + length]
            case 2:
                data[place:place] = data[place : place + length]
            case 3:
                extreme = chance.choice((b"\xff" * 4, b"\xff\xff\xff\x7f", bytes(4), struct.pack("<d", float("nan"))))
                data[place : place + len(extreme)] = extreme
            case 4:
                if chance.random() < 0.3:
                    del data[place:]
            case _:
                data[place:place] = chance.randbytes(length)
    return bytes(data)


def damage_text(content: bytes, chance: random.Random) -> bytes:
    """Return a text with one to three changes: a number replaced, a line cut, repeated or moved; or damaged bytes."""
    if chance.random() < 0.15:
        return damage_bytes(content, chance)
    for _ in range(chance.randint(1, 3)):
        numbers = list(_NUMBER.finditer(content))
        lines = content.split(b"\n")
        row = chance.randrange(len(lines))
        match chance.randrange(5):
            case 0 | 1 if numbers:
                found = chance.choice(numbers)
                content = content[: found.start()] + chance.choice(_WORDS) + content[found.end() :]
            case 2:
                content = b"\n".join([*lines[:row], *lines[row + 1 :]])
            case 3:
                content = b"\n".join([*lines[:row], *[lines[row]] * chance.choice((2, 50)), *lines[row + 1 :]])
            case _:
                place = chance.randrange(len(content) + 1)
                content = content[:place] + chance.choice(_WORDS) + content[place:]
    return content


def damage_json(document: Any, chance: random.Random) -> str:
    """Return a document as text with one to three of its values replaced, removed or repeated."""
    document = json.loads(json.dumps(document))
    for _ in range(chance.randint(1, 3)):
        holders = [each for each in _holders(document) if each]
        if not holders:
            break
        # Values near the top as likely as those in long lists.
        holder = chance.choice(holders[: chance.choice((1, 3, len(holders)))])
        key = chance.choice(list(holder)) if isinstance(holder, dict) else chance.randrange(len(holder))
        match chance.randrange(6):
            case 0:
                del holder[key]
            case 1 if isinstance(holder, list):
                holder.extend([holder[key]] * 3)
            case _:
                holder[key] = deepcopy(chance.choice(_VALUES))
    return json.dumps(document)


def _holders(value: Any) -> list[Any]:
    """Return all dicts and lists in a document, the outer ones first."""
    inner = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else []
    found = [value] if isinstance(value, dict | list) else []
    return found + [each for one in inner for each in _holders(one)]
