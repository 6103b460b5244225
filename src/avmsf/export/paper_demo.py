"""The layout of the paper's web demo, in and out: Gaussians to pick, and a gain of every mode at each of them.

A folder holds `manifest.json` and `picking.bin` (float32, little endian, one array after another: means [N, 3], scales
[N, 3], quaternions [N, 4] as w x y z, opacities [N]), `scene.ply` with the same Gaussians, and one folder for each
variant of the sound with its own `manifest.json` and `modal.bin`: frequencies [M] in Hz, gains [N, M] in float16 or
float32, dampings [M] or [N, M] in 1/s. The demo's player starts every mode as a cosine and knows no noise.
"""

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.errors import ExportError
from avmsf.export.discs import discs
from avmsf.export.formats import Precision
from avmsf.export.normals import outward_normals
from avmsf.export.one_phase import deviation, signed_amplitudes
from avmsf.export.packed_arrays import described, number_in, pack, read_array, read_manifest, unreadable
from avmsf.export.sampled_field import SampledField
from avmsf.export.writing import MANIFEST, Written, generator, write_folder
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import write_splats

PICKING, SCENE, MODAL = "picking.bin", "scene.ply", "modal.bin"
_PICKED = {"means": 3, "scales": 3, "quaternions": 4, "opacities": 1}
_MOST_RATE, _MOST_SECONDS = 768_000, 600
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
    variants of the same Gaussians stay in the folder. Raises `ExportError`, also where it holds variants of others.
    """
    folder = Path(folder)
    shown = discs(field) if cloud is None else cloud
    if len(shown) != len(field):
        raise ExportError(
            f"cloud: expected a Gaussian for each of the field's {len(field)} points, got {len(shown)}; sample the "
            "field at the Gaussians' centers",
            name="cloud",
            value=len(shown),
        )
    if not variant or Path(variant).name != variant or variant.startswith("."):
        raise ExportError.expected("a name that a folder can have", variant, name="variant", advice="use letters")
    gains = _gains(field, precision)
    picking, places = _picking(field, shown)
    modal, tensors = _modal(field, gains)
    others = sorted({path.parent.name for path in folder.glob(f"*/{MODAL}")} - {variant})
    if others and _content(folder / PICKING) != picking:
        raise ExportError(
            f"{folder}: expected a free name, or variants of the same Gaussians, got {', '.join(others)} of others; "
            "choose another folder",
            file=folder,
            value=others,
        )

    def fill(place: Path) -> None:
        (place / PICKING).write_bytes(picking)
        write_splats(shown, place / SCENE)
        (place / variant).mkdir()
        (place / variant / MODAL).write_bytes(modal)
        sound = {"generator": generator(), "file": MODAL, "modes": len(field.frequency), "duration": _seconds(field)}
        sound |= {"sampleRate": field.sample_rate, "phase": "cosine", "arrays": tensors}
        (place / variant / MANIFEST).write_text(json.dumps(sound, indent=1) + "\n")

    manifest = {"name": field.name, "count": len(field), "file": PICKING, "arrays": places, "scene": SCENE}
    sizes = write_folder(folder, fill, {**manifest, "variants": sorted([variant, *others])}, force=force)
    written = torch.from_numpy(gains.astype(np.float32))
    error = deviation(field, sine=None, cosine=written, damping=field.damping)
    return Written(sizes, tuple(_remarks(field, others)), error.waveform, error.spectrum_db)


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
    top = read_manifest(folder)
    count = number_in(top, _COUNTS, folder / MANIFEST)
    picked = {
        name: read_array(folder / PICKING, top, name, (count, width) if width > 1 else (count,), "float32")
        for name, width in _PICKED.items()
    }
    sound_folder = folder / (_only_variant(folder) if variant is None else variant)
    sound, manifest = read_manifest(sound_folder), sound_folder / MANIFEST
    frequency, gains, damping = _read_modes(sound, sound_folder, count)
    rate = sound.get("sampleRate", sound.get("sample_rate", sample_rate)) if sample_rate is None else sample_rate
    if not isinstance(rate, int | float) or not 1 <= rate <= _MOST_RATE:
        raise ExportError.expected(
            f"a sample rate from 1 to {_MOST_RATE} Hz", rate, file=manifest, name="sampleRate", advice="give it"
        )
    seconds = sound.get("duration", 3.0)
    if not isinstance(seconds, int | float) or not 0 < seconds <= _MOST_SECONDS:
        wanted = f"a duration above 0 and up to {_MOST_SECONDS} s"
        raise ExportError.expected(wanted, seconds, file=manifest, name="duration", advice="correct it")
    heard = frequency < 0.5 * rate
    points = torch.from_numpy(picked["means"].copy())
    cosine = torch.from_numpy(gains[:, heard].astype(np.float32))
    field = SampledField(
        points,
        outward_normals(points),
        torch.from_numpy(frequency[heard].astype(np.float64)),
        torch.from_numpy(damping[..., heard].astype(np.float64)),
        torch.zeros_like(cosine),
        cosine,
        torch.zeros(max(1, round(seconds * rate))),
        float(rate),
        name=str(top.get("name", folder.name)),
        origin={"demo": str(folder), "variant": sound_folder.name},
    )
    rest = (torch.from_numpy(picked[name].copy()) for name in ("scales", "quaternions", "opacities"))
    return Demo(field, *rest)


def _read_modes(
    sound: Mapping[str, Any], folder: Path, count: int
) -> tuple[Float[np.ndarray, " modes"], Float[np.ndarray, "points modes"], Float[np.ndarray, "..."]]:
    """Return frequencies, gains at `count` points and dampings of a variant; raises `ExportError` as `read_demo`."""
    place = described(sound, "frequencies", folder / MANIFEST)
    modes = place["shape"][0] if "shape" in place else number_in(sound, _MODES, folder / MANIFEST)
    path = folder / MODAL
    frequency = read_array(path, sound, "frequencies", (modes,), "float32")
    gains = read_array(path, sound, "gains", (count, modes), _gain_kind(sound, path))
    damping = read_array(path, sound, "dampings", _damping_shape(sound, path, count, modes), "float32")
    for name, least, wanted in (("frequencies", frequency.min(), "above 0"), ("dampings", damping.min(), "from 0")):
        if least < 0 or (least == 0 and wanted == "above 0"):
            raise ExportError.expected(f"{name} {wanted}", float(least), file=path, name=name, advice="export it again")
    return frequency, gains, damping


def is_demo(folder: Path) -> bool:
    """Return whether a folder has the layout of the demo."""
    return (folder / MANIFEST).is_file() and (folder / PICKING).is_file()


def _seconds(field: SampledField) -> float:
    return field.samples / field.sample_rate


def _gain_kind(sound: Mapping[str, Any], path: Path) -> str:
    place = described(sound, "gains", path.with_name(MANIFEST))
    kind = place.get("dtype", sound.get("gains_dtype", sound.get("gainsDtype", "float32")))
    if kind not in ("float16", "float32"):
        manifest = path.with_name(MANIFEST)
        raise ExportError.expected(
            "gains in float16 or float32", kind, file=manifest, name="gains", advice="correct it"
        )
    return str(kind)


def _damping_shape(sound: Mapping[str, Any], path: Path, count: int, modes: int) -> tuple[int, ...]:
    """Return the dampings' shape: as it is written, or a row a Gaussian if the file is long enough for that."""
    manifest = path.with_name(MANIFEST)
    place = described(sound, "dampings", manifest)
    if "shape" in place:
        return (count, modes) if len(place["shape"]) == 2 else (modes,)
    others = [described(sound, name, manifest)["offset"] for name in ("frequencies", "gains")]
    behind = min([offset for offset in others if offset > place["offset"]], default=0)
    length = (behind or (path.stat().st_size if path.is_file() else 0)) - place["offset"]
    return (count, modes) if length >= 4 * count * modes and count > 1 else (modes,)


def _only_variant(folder: Path) -> str:
    found = sorted(path.parent.name for path in folder.glob(f"*/{MODAL}"))
    if len(found) != 1:
        raise ExportError(
            f"{folder}: expected one variant, a folder with {MODAL}, got {', '.join(found) or 'none'}; name one",
            file=folder,
            name="variant",
            value=found,
        )
    return found[0]


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise unreadable(path, error, "choose another folder") from error
