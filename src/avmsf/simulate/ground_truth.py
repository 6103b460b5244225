"""What is known of a simulated object and of no recorded one: its modes, and how strongly each blow excited them.

A file `truth.safetensors` holds the tensors under the names of their fields, and in its header one JSON:
{"format": 2, "version": "0.1.0", "names": ["001.wav", ...], "recipe": {...}}

Format 1 is the same without `starts`; it is read too.
"""

import json
import math
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Complex128, Float64
from safetensors.torch import save as to_bytes
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf._utils.state import read_tensors
from avmsf._utils.text import parse_json
from avmsf.errors import SimulationError

FORMAT = 2
"""Number of this format; it grows with every change that older versions could not read."""
TRUTH = "truth.safetensors"
"""Its name in a capture folder."""
_KEY = "avmsf_truth"
_MODES, _TABLES = ("frequency", "damping"), ("gains", "quadrature")
_OPTIONAL = ("contacts", "starts")
_RENAMED = {"modes": "elastic_modes", "contacts": "impacts"}
"""Settings of recipes in files of earlier versions, and their names now."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The modes in a set of simulated recordings, row for row of its `Impacts`.

    Recording i is, but for noise, the sum over modes k of exp(-d_k t) (gains[i, k] sin(2 pi f_k t) + quadrature[i, k]
    cos(2 pi f_k t)), with t the time since the impact's sound arrived, and silence before.
    """

    frequency: Float64[Tensor, " modes"]
    """Damped frequencies, Hz, ascending."""
    damping: Float64[Tensor, " modes"]
    """Amplitude decay rates, 1/s."""
    gains: Float64[Tensor, "contacts modes"]
    """Signed amplitudes in phase, in the unit of the recordings."""
    quadrature: Float64[Tensor, "contacts modes"]
    """Amplitudes in quadrature."""
    names: tuple[str, ...]
    """The recordings' names, in the order of the rows."""
    recipe: dict[str, Any] = field(default_factory=dict)
    """All settings that the object was made with, as plain values."""
    contacts: Float64[Tensor, "contacts 3"] | None = None
    """True contacts, meters; the table of impacts has them with errors. None if the table is exact."""
    starts: Float64[Tensor, " contacts"] | None = None
    """Sample of its file, counted from 0 and between samples too, at which t = 0 of each recording lies: sample n of
    recording i is at t = (n - starts[i]) / sample_rate. None where all files start with the impact's sound."""

    @property
    def amplitudes(self) -> Complex128[Tensor, "contacts modes"]:
        """Amplitudes A: recording i is the real part of the sum of A[i] exp((-d + 2 pi i f) t)."""
        return torch.complex(self.quadrature, -self.gains)

    def after(self, seconds: float) -> "Truth":
        """Return the same modes with time counted from `seconds` later in all recordings, before where negative.

        Each mode's amplitude is multiplied by exp(pole * seconds). `starts` still name the impacts.
        """
        poles = torch.complex(-self.damping, 2 * math.pi * self.frequency)
        amplitudes = self.amplitudes * torch.exp(poles * seconds)
        return replace(self, gains=-amplitudes.imag, quadrature=amplitudes.real.clone())


def write_truth(truth: Truth, path: str | Path) -> None:
    """Write a truth to one file, which `read_truth` reads back to the last bit.

    A file that is there stays whole until the new one is. Raises SimulationError where the file cannot be written, or
    could not be read back.
    """
    path = Path(path)
    tensors = {name: getattr(truth, name) for name in (*_MODES, *_TABLES, *_OPTIONAL)}
    tensors = {name: tensor.clone().contiguous() for name, tensor in tensors.items() if tensor is not None}
    _expect_tensors(tensors, len(truth.names), path)
    record = {"format": FORMAT, "version": version("avmsf"), "names": list(truth.names), "recipe": truth.recipe}
    try:
        words = json.dumps(record, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise SimulationError(
            f"{path}: expected settings of finite numbers, strings, lists and dicts, got others ({error})",
            file=path,
            name="recipe",
            value=str(error),
        ) from error
    content = to_bytes(tensors, {_KEY: words})
    write_whole(path, lambda place: place.write_bytes(content), raising=SimulationError)


def read_truth(path: str | Path) -> Truth:
    """Read what `write_truth` wrote; `path` is the file, or the capture folder that holds it.

    Raises SimulationError for a file that is missing, cut short, of another kind or of another format, and where its
    tensors do not fit together.
    """
    path = Path(path)
    path = path / TRUTH if path.is_dir() else path
    words, tensors = _read(path)
    record = _understand(words, path)
    _expect_tensors(tensors, len(record["names"]), path)
    recipe = {_RENAMED.get(name, name): value for name, value in record["recipe"].items()}
    return Truth(names=tuple(record["names"]), recipe=recipe, **tensors)


def _read(path: Path) -> tuple[str, dict[str, Tensor]]:
    what, advice = "the ground truth of a simulated object", "make the object with avmsf simulate"
    return read_tensors(path, _KEY, what=what, advice=advice, raising=SimulationError)


def _understand(words: str, path: Path) -> dict[str, Any]:
    """Return the header's record after looking at every entry of it."""
    try:
        record = parse_json(words)
        found, writer, names = record["format"], record["version"], record["names"]
        listed = isinstance(names, list) and all(isinstance(name, str) for name in names)
        if found in (1, FORMAT) and not (listed and isinstance(record["recipe"], dict)):
            raise ValueError("names or settings of another type")
    except (ValueError, TypeError, KeyError) as error:
        raise SimulationError(
            f"{path}: expected the header of a simulated object's ground truth, got {error!r}; simulate the object "
            "again",
            file=path,
            name="header",
            value=repr(error),
        ) from error
    if found not in (1, FORMAT):
        raise SimulationError(
            f"{path}: expected a ground truth of format 1 or {FORMAT}, got format {found}, written by avmsf {writer} "
            f"(this is avmsf {version('avmsf')}); install avmsf {writer} or newer, or simulate the object again",
            file=path,
            name="format",
            value=found,
        )
    return record


def _expect_tensors(tensors: dict[str, Tensor], contacts: int, path: Path) -> None:
    modes = len(tensors["frequency"]) if "frequency" in tensors and tensors["frequency"].ndim == 1 else 0
    expected: dict[str, tuple[int, ...]] = dict.fromkeys(_MODES, (modes,)) | dict.fromkeys(_TABLES, (contacts, modes))
    expected |= {name: size for name, size in (("contacts", (contacts, 3)), ("starts", (contacts,))) if name in tensors}
    found = {name: tuple(tensor.shape) for name, tensor in tensors.items() if tensor.dtype == torch.float64}
    if found != expected or tensors.keys() != expected.keys():
        raise SimulationError(
            f"{path}: expected the float64 tensors {expected}, got "
            f"{ {name: tuple(tensor.shape) for name, tensor in tensors.items()} }; simulate the object again",
            file=path,
            name="tensors",
            value=sorted(name for name in expected.keys() | tensors.keys() if expected.get(name) != found.get(name)),
        )
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise SimulationError(
                f"{path}: expected finite {name}, got others; simulate the object again", file=path, name=name
            )
