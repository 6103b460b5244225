"""The two YAML files of each recording of ObjectFolder Real: the recorder's gains, and the impact's peak force."""

import math
import re
from dataclasses import dataclass
from pathlib import Path

from avmsf.errors import DatasetError

PAD_DB = 20.0
"""What the recorder's pad switch takes away, dB."""
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


@dataclass(frozen=True)
class Gains:
    """How the recorder's two inputs were set: the hammer's force first, the microphone second."""

    gain_db: tuple[float, float]
    """Of the amplifiers."""
    pad: tuple[bool, bool]
    """Whether the pad switch, which takes 20 dB away, was pressed."""

    @property
    def microphone_db(self) -> float:
        """By how much the microphone's recording is louder than without amplifier and pad, dB."""
        return self.gain_db[1] - PAD_DB * self.pad[1]

    def __str__(self) -> str:
        return f"{self.gain_db[1]:g} dB{' less 20 dB by the pad' * self.pad[1]}"


def read_gains(path: Path) -> Gains:
    """Read a `metadata.yaml`: two lists of two numbers, `gain` and `pad`, in either of YAML's ways to write lists.

    Raises DatasetError where the file holds anything else.
    """
    text = _read(path)
    gain, pad = _pair(text, "gain", path), _pair(text, "pad", path)
    if not set(pad) <= {0.0, 1.0}:
        raise DatasetError.expected(
            "pad 0 or 1 for each channel", pad, got=f"{pad[0]:g} and {pad[1]:g}", file=path, name="pad"
        )
    return Gains(gain, (pad[0] == 1.0, pad[1] == 1.0))


def read_newtons(path: Path) -> float:
    """Read the peak force of a `striking_force.yaml`, newtons. Raises DatasetError where it holds no force above 0."""
    found = re.findall(rf"\bstriking_force_newtons['\"]?\s*:\s*({_NUMBER})[\s,}}\]]", _read(path) + "\n")
    if len(found) != 1 or not 0 < float(found[0]) < math.inf:
        raise DatasetError(
            f"{path}: expected one striking_force_newtons above 0, got {', '.join(found) if found else 'none'}",
            file=path,
            name="striking_force_newtons",
            value=tuple(map(float, found)),
        )
    return float(found[0])


def _pair(text: str, key: str, path: Path) -> tuple[float, float]:
    # Either `gain: [12, 18]`, or the key alone and below it a line `- 12` for each number.
    flow = rf"\[\s*({_NUMBER})\s*,\s*({_NUMBER})\s*\]"
    block = rf"\n\s*-\s*({_NUMBER})[ \t]*\n\s*-\s*({_NUMBER})(?![ \t]*\n\s*-)"
    found = re.search(rf"^{key}[ \t]*:[ \t]*(?:{flow}|{block})[ \t]*$", text, flags=re.MULTILINE)
    if found is None:
        held = text.strip()[:80]
        raise DatasetError.expected(f"{key} with a list of two numbers", held, file=path, name=key)
    first, second = (float(number) for number in found.groups() if number is not None)
    return first, second


def _read(path: Path) -> str:
    # Windows wrote the files: universal newlines turn their line ends.
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise DatasetError.expected("a file", file=path, advice="unpack or download it again") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError.expected(
            "UTF-8 text", got="bytes of another kind", file=path, advice="unpack or download it again"
        ) from error
