"""The layout of the paper's web demo, in and out: Gaussians to pick, and a gain of every mode at each of them.

A folder holds `manifest.json` and `picking.bin` (float32, little endian, one array after another: means [N, 3], scales
[N, 3], quaternions [N, 4] as w x y z, opacities [N]), `scene.ply` with the same Gaussians, and one folder for each
variant of the sound with its own `manifest.json` and `modal.bin`: frequencies [M] in Hz, gains [N, M] in float16 or
float32, dampings [M] or [N, M] in 1/s. The demo's player starts every mode as a cosine and knows no noise.
"""

import json
import math
import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from avmsf._utils.text import read_json
from avmsf.errors import ExportError
from avmsf.export.formats import Precision
from avmsf.export.one_phase import approximation_error, signed_amplitudes
from avmsf.export.sampled_field import SampledField, outward_normals
from avmsf.export.writing import MANIFEST, Written, generator, pack, write_folder
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.initialize import StartPoints, starting_cloud
from avmsf.gaussians.ply import write_splats

PICKING, SCENE, MODAL = "picking.bin", "scene.ply", "modal.bin"
_PICKED = {"means": 3, "scales": 3, "quaternions": 4, "opacities": 1}
_MAX_RATE, _MAX_SECONDS = 768_000, 600
"""Largest sample rate, Hz, and duration, seconds; larger values are taken for errors."""
_COUNTS = ("count", "num_gaussians", "numGaussians", "N")
_MODES = ("modes", "num_modes", "numModes", "M")


@dataclass(frozen=True, eq=False)
class Demo:
    """What a folder of the demo holds."""

    field: SampledField
    """The sound, at the Gaussians' centers."""
    scales: Float[Tensor, "points 3"]
    """Standard deviations of the Gaussians along their own axes, meters."""
    rotations: Float[Tensor, "points 4"]
    """Their quaternions w, x, y, z."""
    opacities: Float[Tensor, " points"]
    """0 to 1."""


def write_demo(
    field: SampledField,
    folder: str | Path,
    *,
    cloud: GaussianCloud | None = None,
    variant: str = "original",
    precision: Precision = "float32",
    force: bool = False,
) -> Written:
    """Write the demo's folder; where there is no `cloud` whose centers are the field's points, with a disc at each.

    Modes have the field's level and start as cosines, whatever their phase is in the field. With `force`, other
    variants of the same Gaussians stay in the folder. Raises `ExportError`, also where it holds variants of others, and
    without a `cloud` `SceneError` for fewer than four points.
    """
    folder = Path(folder)
    shown = _discs(field) if cloud is None else cloud
    if len(shown) != len(field):
        wanted, advice = f"one for each of {len(field)} points", "sample the field at the Gaussians' centers"
        raise ExportError.expected(wanted, len(shown), name="cloud", advice=advice)
    if not variant or Path(variant).name != variant or variant.startswith("."):
        raise ExportError.expected("a name that a folder can have", variant, name="variant", advice="use letters")
    gains = _gains(field, precision)
    picking, places = _picking(field, shown)
    modal, tensors = _modal(field, gains)
    others = sorted({path.parent.name for path in folder.glob(f"*/{MODAL}")} - {variant})
    if others and _content(folder / PICKING) != picking:
        wanted = "a free name, or variants of the same Gaussians,"
        raise ExportError.expected(wanted, others, file=folder, advice="choose another folder")

    def fill(place: Path) -> None:
        (place / PICKING).write_bytes(picking)
        write_splats(shown, place / SCENE)
        (place / variant).mkdir()
        (place / variant / MODAL).write_bytes(modal)
        sound = {"generator": generator(), "file": MODAL, "modes": len(field.frequency)}
        sound |= {"duration": field.samples / field.sample_rate, "sampleRate": field.sample_rate}
        sound |= {"phase": "cosine", "arrays": tensors}
        (place / variant / MANIFEST).write_text(json.dumps(sound, indent=1) + "\n")
        for other in others:
            shutil.copytree(folder / other, place / other)

    manifest = {"name": field.name, "count": len(field), "file": PICKING, "arrays": places, "scene": SCENE}
    sizes = write_folder(folder, fill, {**manifest, "variants": sorted([variant, *others])}, force=force)
    written = torch.from_numpy(gains.astype(np.float32))
    error = approximation_error(field, sine=None, cosine=written, damping=field.damping)
    return Written(sizes, tuple(_remarks(field, others)), error.waveform, error.spectrum_db)


def _discs(field: SampledField) -> GaussianCloud:
    """Return a flat gray Gaussian at each point, tangent to the surface, as wide as the distance between points."""
    start = StartPoints(field.points, torch.full_like(field.points, 0.7), field.normals)
    return starting_cloud(start, degree=0, scale=0.6, opacity=0.95, flatness=0.1)


def _gains(field: SampledField, precision: Precision) -> Float[np.ndarray, "points modes"]:
    """Return the gains of modes that start as cosines; raises `ExportError` where `precision` cannot hold them."""
    amplitudes = signed_amplitudes(field)
    gains = amplitudes.numpy().astype(f"<{np.dtype(precision).str[1:]}")
    if not np.isfinite(gains).all():
        loudest = float(amplitudes.abs().max())
        raise ExportError.expected(
            f"gains up to 65504 for {precision}", loudest, got=f"{loudest:.3g}", name="precision", advice="take float32"
        )
    return gains


def _picking(field: SampledField, shown: GaussianCloud) -> tuple[bytes, dict[str, dict[str, Any]]]:
    """Return the content of `picking.bin`, and where its arrays are."""
    arrays = {
        "means": field.points,
        "scales": shown.log_scales.exp(),
        "quaternions": torch.nn.functional.normalize(shown.rotations, dim=1),
        "opacities": shown.opacities,
    }
    return pack({name: array.numpy().astype("<f4") for name, array in arrays.items()})


def _modal(field: SampledField, gains: Float[np.ndarray, "points modes"]) -> tuple[bytes, dict[str, dict[str, Any]]]:
    """Return the content of `modal.bin`, and where its arrays are."""
    frequency, damping = (array.numpy().astype("<f4") for array in (field.frequency, field.damping))
    return pack({"frequencies": frequency, "gains": gains, "dampings": damping})


def _remarks(field: SampledField, others: Collection[str]) -> list[str]:
    """Return notes on the sound, and on the folder's other variants."""
    remarks = ["every mode starts as a cosine in the demo, with the field's level"]
    if field.noise.any():
        remarks.append("the residual noise is left out, since the demo has none")
    if others:
        remarks.append(f"the folder's other variants are unchanged: {', '.join(others)}")
    return remarks


def read_demo(folder: str | Path, *, variant: str | None = None, sample_rate: float | None = None) -> Demo:
    """Read a folder of the demo: the named variant, or the only one, at `sample_rate` (Hz) if its manifest has none.

    Modes at half the sample rate and above are left out. Raises `ExportError`, with file and array, for a folder of
    another kind, truncated files, and numbers that are not finite.
    """
    folder = Path(folder)
    top = _Manifest(folder)
    count = top.number(_COUNTS)
    picked = {
        name: top.array(PICKING, name, (count, width) if width > 1 else (count,)) for name, width in _PICKED.items()
    }
    sound_folder = folder / (_only_variant(folder) if variant is None else variant)
    sound = _Manifest(sound_folder)
    frequency, gains, damping = _read_modes(sound, count)
    rate = sound.values.get("sampleRate", sound.values.get("sample_rate")) if sample_rate is None else sample_rate
    if not isinstance(rate, int | float) or not 1 <= rate <= _MAX_RATE:
        raise sound.error("sampleRate", f"a sample rate from 1 to {_MAX_RATE} Hz", rate)
    seconds = sound.values.get("duration", 3.0)
    if not isinstance(seconds, int | float) or not 0 < seconds <= _MAX_SECONDS:
        raise sound.error("duration", f"a duration above 0 and up to {_MAX_SECONDS} s", seconds)
    audible = frequency < 0.5 * rate
    points = torch.from_numpy(picked["means"].copy())
    cosine = torch.from_numpy(gains[:, audible].astype(np.float32))
    field = SampledField(
        points,
        outward_normals(points),
        torch.from_numpy(frequency[audible].astype(np.float64)),
        torch.from_numpy(damping[..., audible].astype(np.float64)),
        torch.zeros_like(cosine),
        cosine,
        torch.zeros(max(1, round(seconds * rate))),
        float(rate),
        name=str(top.values.get("name", folder.name)),
        origin={"demo": str(folder), "variant": sound_folder.name},
    )
    rest = (torch.from_numpy(picked[name].copy()) for name in ("scales", "quaternions", "opacities"))
    return Demo(field, *rest)


class _Manifest:
    """The manifest of a folder, and the arrays that it describes. Methods raise `ExportError` for what cannot be."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / MANIFEST
        try:
            self.values = read_json(self.path)
        except OSError as error:
            raise _unreadable(self.path, error, "name a folder of the paper's demo") from error
        except ValueError as error:
            raise ExportError.expected("JSON", got=str(error), file=self.path, advice="export it again") from error
        if not isinstance(self.values, dict):
            kind = type(self.values).__name__
            raise ExportError.expected("a JSON object", kind, file=self.path, advice="export it again")

    def error(self, name: str, wanted: str, value: Any) -> ExportError:
        """Return the error of an entry."""
        return ExportError.expected(f"{wanted} as {name}", value, file=self.path, name=name, advice="correct it")

    def number(self, names: tuple[str, ...]) -> int:
        """Return a whole number from 1 under one of these names."""
        value = next((self.values[name] for name in names if name in self.values), None)
        if type(value) is not int or value < 1:
            raise self.error(names[0], "a whole number from 1", value)
        return value

    def described(self, name: str) -> dict[str, Any]:
        """Return where an array is: its offset in bytes alone, or a record of it, at the top or in a group."""
        groups = [self.values, *(self.values[key] for key in ("arrays", "offsets", "buffers") if key in self.values)]
        found = next((group[name] for group in groups if isinstance(group, Mapping) and name in group), None)
        record = {"offset": found} if type(found) is int else found
        if not isinstance(record, dict):
            raise self.error(f"{name}.offset", "an offset in bytes", found)
        record = {**record, "offset": record.get("offset", record.get("byteOffset"))}
        shape = record.get("shape", [1])
        if not (isinstance(shape, list) and shape and all(type(each) is int and each > 0 for each in shape)):
            raise self.error(f"{name}.shape", "whole numbers from 1", shape)
        if type(record["offset"]) is not int or record["offset"] < 0:
            raise self.error(f"{name}.offset", "an offset in bytes", found)
        return record

    def array(self, file: str, name: str, shape: tuple[int, ...], kind: str = "float32") -> Shaped[np.ndarray, "..."]:
        """Return an array of a file in the folder, of such a shape and type, whose numbers are finite."""
        record, path = self.described(name), self.path.with_name(file)
        if tuple(record.get("shape", shape)) not in (shape, (*shape, 1)):
            raise self.error(name, f"the shape {list(shape)} of the other manifest", record["shape"])
        try:
            content = path.read_bytes()
        except OSError as error:
            raise _unreadable(path, error, "export it again") from error
        layout = np.dtype(kind).newbyteorder("<")
        needed = record["offset"] + layout.itemsize * math.prod(shape)
        if needed > len(content):
            wanted = f"{needed} bytes or more for {name}"
            raise ExportError.expected(wanted, len(content), file=path, name=name, advice="copy the file again")
        values = np.frombuffer(content, layout, math.prod(shape), record["offset"]).reshape(shape)
        wrong = np.argwhere(~np.isfinite(values))
        if len(wrong):
            row, value = int(wrong[0][0]), float(values[tuple(wrong[0])])
            raise ExportError.expected(f"finite {name}", value, file=path, row=row, name=name, advice="export it again")
        return values


def _read_modes(
    sound: _Manifest, count: int
) -> tuple[Float[np.ndarray, " modes"], Float[np.ndarray, "points modes"], Float[np.ndarray, "..."]]:
    """Return frequencies, gains at `count` points and dampings of a variant; raises `ExportError` as `read_demo`."""
    records = {name: sound.described(name) for name in ("frequencies", "gains", "dampings")}
    place = records["frequencies"]
    modes = place["shape"][0] if "shape" in place else sound.number(_MODES)
    kind = records["gains"].get("dtype", sound.values.get("gains_dtype", sound.values.get("gainsDtype", "float32")))
    if kind not in ("float16", "float32"):
        raise sound.error("gains", "float16 or float32", kind)
    frequency = sound.array(MODAL, "frequencies", (modes,))
    gains = sound.array(MODAL, "gains", (count, modes), kind)
    damping = sound.array(MODAL, "dampings", _damping_shape(records, sound.path.with_name(MODAL), count, modes))
    for name, least, wanted in (("frequencies", frequency.min(), "above 0"), ("dampings", damping.min(), "from 0")):
        if least < 0 or (least == 0 and wanted == "above 0"):
            path = sound.path.with_name(MODAL)
            raise ExportError.expected(f"{name} {wanted}", float(least), file=path, name=name, advice="export it again")
    return frequency, gains, damping


def _damping_shape(records: Mapping[str, Any], path: Path, count: int, modes: int) -> tuple[int, ...]:
    """Return the dampings' shape: as it is written, or a row a Gaussian if the file is long enough for that."""
    place = records["dampings"]
    if "shape" in place:
        return (count, modes) if len(place["shape"]) == 2 else (modes,)
    behind = min([each["offset"] for each in records.values() if each["offset"] > place["offset"]], default=0)
    length = (behind or path.stat().st_size) - place["offset"]
    return (count, modes) if length >= 4 * count * modes and count > 1 else (modes,)


def _only_variant(folder: Path) -> str:
    found = sorted(path.parent.name for path in folder.glob(f"*/{MODAL}"))
    if len(found) != 1:
        raise ExportError.expected(
            f"one variant, a folder with {MODAL},", found, file=folder, name="variant", advice="name one"
        )
    return found[0]


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise _unreadable(path, error, "choose another folder") from error


def _unreadable(path: Path, error: OSError, advice: str) -> ExportError:
    return ExportError.expected("a readable file", error.strerror or str(error), file=path, advice=advice)


def is_demo(folder: Path) -> bool:
    """Return whether a folder has the layout of the demo."""
    return (folder / MANIFEST).is_file() and (folder / PICKING).is_file()
