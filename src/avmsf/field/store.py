"""A sound field as one file: safetensors, and one JSON in its header for all that is no tensor.

Tensors are named by the path of their field: `bank.frequency`, `phase`, `gain_field.points`. The header's metadata
holds under the key `avmsf` the record that `avmsf.field.header` describes.
"""

import math
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes
from torch import Tensor

from avmsf.capture.audio import MAX_PEAK
from avmsf.errors import FieldFileError
from avmsf.field.gainfield import GainField
from avmsf.field.header import FORMAT, Header, broken, read_header
from avmsf.field.kinds import FITTED
from avmsf.field.scaledgains import ScaledGains
from avmsf.field.soundfield import SoundField
from avmsf.files import write_whole
from avmsf.modal.bank import ModalBank
from avmsf.modal.residual import Residual

_KEY = "avmsf"
_GAIN_FIELD = "gain_field."
_POSITIVE = ("bank.frequency", "bank.damping")
_MOST = {"bank.frequency": 1e9, "bank.damping": 1e9, "residual.magnitude": MAX_PEAK}
"""Largest values: hertz and 1/s beyond any solid's modes, and noise as loud as the loudest recording."""
_KINDS: dict[str, type[GainField]] = {**FITTED, ScaledGains.kind: ScaledGains}
"""The gain fields that a file may hold, by what it calls them."""


def save(field: SoundField, path: str | Path) -> None:
    """Write a field to one file, which `load` reads back to the last bit.

    A file that is there is replaced in one step and stays whole until then; folders that are missing are made. Raises
    `FieldFileError` where the file cannot be written, and for a field that could not be read back.
    """
    path = Path(path)
    try:
        header, tensors = Header.of(field), _tensors(field)
    except ValueError as error:
        raise FieldFileError(f"{path}: {error}: such a field cannot be kept") from error
    _expect_tensors(tensors, header, path)
    content = to_bytes(tensors, {_KEY: header.to_json(path)})
    write_whole(path, lambda place: place.write_bytes(content))


def load(path: str | Path) -> SoundField:
    """Read a field that `save` wrote; it renders what the saved one does, to the last bit.

    Raises `FieldFileError` for a file that is missing, cut short, of another kind or of a newer format, and where a
    tensor is missing, unexpected, of another shape or dtype, or not finite.
    """
    path = Path(path)
    words, tensors = _read(path)
    header = read_header(words, path)
    _expect_tensors(tensors, header, path)
    try:
        gains = _KINDS[header.kind].restore(header.gain_field, _of_gain_field(tensors))
    except (ValueError, RuntimeError) as error:  # RuntimeError: torch's decompositions, of damaged values
        raise broken(path, error) from error
    return SoundField(
        ModalBank(tensors["bank.frequency"], tensors["bank.damping"]),
        gains,
        tensors["phase"],
        Residual(tensors["residual.magnitude"], tensors.get("residual.recordings")),
        header.sample_rate,
        header.samples,
        header.origin,
    )


def _tensors(field: SoundField) -> dict[str, Tensor]:
    named = {
        "bank.frequency": field.bank.frequency,
        "bank.damping": field.bank.damping,
        "phase": field.phase,
        "residual.magnitude": field.residual.magnitude,
    }
    if field.residual.recordings is not None:
        named["residual.recordings"] = field.residual.recordings
    named |= {_GAIN_FIELD + name: tensor for name, tensor in field.gain_field.tensors().items()}
    # Safetensors refuses tensors that share memory, as a field's points may with its features.
    return {name: tensor.detach().cpu().clone(memory_format=torch.contiguous_format) for name, tensor in named.items()}


def _read(path: Path) -> tuple[str, dict[str, Tensor]]:
    """Return the header's record and the tensors of a file that is ours."""
    if not path.exists():
        raise FieldFileError(f"{path}: expected a sound field, found no such file: check the name, or fit and save one")
    try:
        with safe_open(path, framework="pt") as file:
            words = (file.metadata() or {}).get(_KEY)
            if words is None:
                raise FieldFileError(
                    f"{path}: expected a sound field, found a safetensors file of something else (its metadata has no "
                    f"entry {_KEY!r}): name a file that avmsf saved"
                )
            # Clones, for what the file maps into memory would change with it.
            return words, {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise FieldFileError(f"{path}: expected a sound field, found {_guess(path)}") from error


def _guess(path: Path) -> str:
    """Return what a file is that safetensors cannot read, and what to do."""
    if path.is_dir():
        return "a folder: name the file in it"
    try:
        with open(path, "rb") as file:
            start = file.read(9)
    except OSError as error:
        return f"a file that cannot be read ({error.strerror}): check its permissions"
    if not start:
        return "an empty file: copy it again, or fit and save it again"
    # Eight bytes of length, then the header's opening brace.
    if start[8:] == b"{":
        return "one that is cut short or damaged: copy it again, or fit and save it again"
    return f"a file of another kind, which starts with {start[:8]!r}: name a file that avmsf saved"


def _expect_tensors(tensors: dict[str, Tensor], header: Header, path: Path) -> None:
    """Compare names, shapes and dtypes with what the header's sizes ask for, and the values with what they mean."""
    expected = _skeleton(header, path)
    missing, unexpected = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    if missing or unexpected:
        raise FieldFileError(
            f"{path}: the tensors are not those of format {FORMAT}: missing {', '.join(missing) or 'none'}; unexpected "
            f"{', '.join(unexpected) or 'none'}: the file was changed after it was saved, fit and save it again"
        )
    for name, tensor in tensors.items():
        like = expected[name]
        if tensor.shape != like.shape or tensor.dtype != like.dtype:
            raise FieldFileError(
                f"{path}: expected {name} as {_named(like)}, found {_named(tensor)}: the header and the tensors do not "
                "belong together, fit and save the field again"
            )
        least, most = (float(each) for each in tensor.aminmax()) if tensor.numel() else (0.0, 0.0)
        negative = least < 0 and name == "residual.magnitude"
        if not bool(torch.isfinite(tensor).all()) or (name in _POSITIVE and least <= 0) or negative:
            wanted = "positive" if name in _POSITIVE else "not negative" if negative else "finite"
            raise FieldFileError(f"{path}: expected {name} to be {wanted} throughout, found otherwise: fit it again")
        if most > _MOST.get(name, math.inf):
            raise FieldFileError(f"{path}: expected {name} up to {_MOST[name]:g}, got {most:.3g}: fit the field again")


def _skeleton(header: Header, path: Path) -> dict[str, Tensor]:
    """Return tensors of the names, shapes and dtypes of a field with these sizes, which take no memory."""
    if header.kind not in _KINDS:
        raise broken(path, ValueError(f"gain_field.kind is {header.kind!r}, not {', '.join(_KINDS)}"))
    try:
        gains = _KINDS[header.kind].skeleton(header.gain_field)
    except (ValueError, TypeError, KeyError, RuntimeError) as error:  # RuntimeError: torch, of sizes beyond 2^63
        raise broken(path, error) from error
    if header.gain_field["modes"] != header.modes:
        raise broken(
            path, ValueError(f"{header.gain_field['modes']} modes have gains, {header.modes} have frequencies")
        )
    bank = torch.empty(header.modes, dtype=torch.float64, device="meta")
    named = {"bank.frequency": bank, "bank.damping": bank, "phase": bank}
    named["residual.magnitude"] = torch.empty(header.bins, device="meta")
    if header.recordings is not None:
        if header.gain_field.get("contacts") != header.recordings[0]:
            raise broken(path, ValueError(f"sizes.recordings is {header.recordings}, of other contacts than the gains"))
        named["residual.recordings"] = torch.empty(header.recordings, device="meta")
    return named | {_GAIN_FIELD + name: tensor for name, tensor in gains.items()}


def _of_gain_field(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(_GAIN_FIELD): each for name, each in tensors.items() if name.startswith(_GAIN_FIELD)}


def _named(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')}{list(tensor.shape)}"
