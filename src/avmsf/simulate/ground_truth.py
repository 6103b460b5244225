"""What is known of a simulated object and of no recorded one: its modes, and how strongly each impact excited them.

A file `truth.safetensors` holds the tensors under the names of their fields, and in its header one JSON:
{"format": 2, "version": "0.1.0", "names": ["001.wav", ...], "recipe": {...}}
"""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from avmsf._utils.headers import FileKind
from avmsf._utils.tensor_files import TensorReader, read_tensors, write_tensors
from avmsf.errors import SimulationError

TRUTH = "truth.safetensors"
"""Its name in a capture folder."""
_KIND = FileKind(
    "avmsf_truth",
    "the ground truth of a simulated object",
    "make the object with avmsf simulate",
    SimulationError,
    formats=(2,),
)
_OPTIONAL = ("contacts", "starts", "shifts")
_RENAMED = {"modes": "elastic_modes", "contacts": "impacts"}
"""Settings of recipes in files of earlier versions, and their names now."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The modes in a set of simulated recordings, row for row of its `Impacts`.

    Recording i is, but for noise, the sum over modes k of Im(gains[i, k] exp((-d_k + 2 pi i f_k) t)), with t the time
    since the impact's sound arrived, and silence before.
    """

    frequency: Float64[Tensor, " modes"]
    """Damped frequencies, Hz, ascending."""
    damping: Float64[Tensor, " modes"]
    """Amplitude decay rates, 1/s."""
    gains: Complex128[Tensor, "contacts modes"]
    """In the unit of the recordings: the real part of sines, the imaginary part of cosines."""
    names: tuple[str, ...]
    """The recordings' names, in the order of the rows."""
    recipe: dict[str, Any] = field(default_factory=dict)
    """All settings that the object was made with, as plain values."""
    contacts: Float64[Tensor, "contacts 3"] | None = None
    """True contacts, meters; the table of impacts has them with errors. None if the table is exact."""
    starts: Float64[Tensor, " contacts"] | None = None
    """Sample of its file, counted from 0 and between samples too, at which t = 0 of each recording lies: sample n of
    recording i is at t = (n - starts[i]) / sample_rate. None where all files start with the impact's sound."""
    shifts: Float64[Tensor, "contacts modes"] | None = None
    """Relative shifts of the frequencies, f_ik = f_k (1 + shifts[i, k]); None where all recordings have the same."""

    @property
    def amplitudes(self) -> Complex128[Tensor, "contacts modes"]:
        """Amplitudes A: recording i is the real part of the sum of A[i] exp((-d + 2 pi i f) t)."""
        return -1j * self.gains

    def after(self, seconds: float) -> "Truth":
        """Return the same modes with time counted from `seconds` later in all recordings, before where negative.

        Each mode's amplitude is multiplied by exp(pole * seconds). `starts` still name the impacts.
        """
        factors = 1.0 if self.shifts is None else 1.0 + self.shifts
        poles = torch.complex(-self.damping.expand_as(self.gains.real), 2 * math.pi * self.frequency * factors)
        return replace(self, gains=self.gains * torch.exp(poles * seconds))


def write_truth(truth: Truth, path: str | Path) -> None:
    """Write a truth to one file, which `read_truth` reads back to the last bit.

    A file that is there stays whole until the new one is. Raises SimulationError where the file cannot be written, or
    could not be read back.
    """
    path = Path(path)
    tensors = {"frequency": truth.frequency, "damping": truth.damping}
    tensors |= {"gains": truth.gains.real.contiguous(), "quadrature": truth.gains.imag.contiguous()}
    tensors |= {name: each for name in _OPTIONAL if (each := getattr(truth, name)) is not None}
    record = {"names": list(truth.names), "recipe": truth.recipe}
    _restored(tensors, record, path)
    write_tensors(path, tensors, _KIND.to_text(record, path, name="recipe"), _KIND)


def read_truth(path: str | Path) -> Truth:
    """Read what `write_truth` wrote; `path` is the file, or the capture folder that holds it.

    Raises SimulationError for a file that is missing, cut short, of another kind or of another format, and where its
    tensors do not fit together.
    """
    path = Path(path)
    path = path / TRUTH if path.is_dir() else path
    text, tensors = read_tensors(path, _KIND)
    record = _KIND.parse(text, path, _check_record)
    return _restored(tensors, record, path)


def _check_record(record: dict[str, Any]) -> None:
    names = record["names"]
    listed = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not (listed and isinstance(record["recipe"], dict)):
        raise ValueError("names or settings of another type")


def _restored(tensors: dict[str, Tensor], record: dict[str, Any], path: Path) -> Truth:
    """Return the truth. Raises SimulationError unless the tensors fit together and to the names, and are finite."""
    contacts, modes = len(record["names"]), tensors["frequency"].numel() if "frequency" in tensors else 0
    read = TensorReader(tensors, path, _KIND)
    frequency, damping = read("frequency", modes), read("damping", modes)
    gains = torch.complex(read("gains", contacts, modes), read("quadrature", contacts, modes))
    sizes = {"contacts": (contacts, 3), "starts": (contacts,), "shifts": (contacts, modes)}
    known = {name: read(name, *size) for name, size in sizes.items() if name in tensors}
    read.expect_end()
    recipe = {_RENAMED.get(name, name): value for name, value in record["recipe"].items()}
    return Truth(frequency, damping, gains, tuple(record["names"]), recipe, **known)
