"""The layout of the paper's web demo, in and out: Gaussians to pick, and a gain of every mode at each of them.

A folder holds `manifest.json` and `picking.bin` (float32, little endian, one array after another: means [N, 3], scales
[N, 3], quaternions [N, 4] as w x y z, opacities [N]), `scene.ply` with the same Gaussians, and one folder for each
variant of the sound with its own `manifest.json` and `modal.bin`: frequencies [M] in Hz, gains [N, M] in float16 or
float32, dampings [M] or [N, M] in 1/s. The demo's player starts every mode as a cosine and knows no noise.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Shaped
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.errors import ExportError
from avmsf.export.normals import outward_normals
from avmsf.export.onephase import deviation, signed_amplitudes
from avmsf.export.sampledfield import SampledField
from avmsf.export.written import MANIFEST, Written, generator, write_folder
from avmsf.scene.gaussians import GaussianCloud
from avmsf.scene.ply import write_splats
from avmsf.scene.start import ZEROTH

PICKING, SCENE, MODAL = "picking.bin", "scene.ply", "modal.bin"
Precision = Literal["float16", "float32"]
_GREY = 0.7
_PICKED = {"means": 3, "scales": 3, "quaternions": 4, "opacities": 1}
_COUNTS = ("count", "num_gaussians", "numGaussians", "N")
_MODES = ("modes", "num_modes", "numModes", "M")


@dataclass(frozen=True, eq=False)
class Demo:
    """What a folder of the demo holds."""

    field: SampledField
    """The sound, at the Gaussians' centers."""
    scales: Float[Tensor, "points 3"]
    """Standard deviations of the Gaussians along their own axes, metres."""
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

    Modes keep their loudness and start as cosines, whatever their phase is in the field. Raises `ExportError`.
    """
    shown = discs(field) if cloud is None else cloud
    if len(shown) != len(field):
        raise ExportError(
            f"expected a Gaussian for each of the field's {len(field)} points, found {len(shown)}: sample the field at "
            "the Gaussians' centers"
        )
    if not variant or Path(variant).name != variant or variant.startswith("."):
        raise ExportError(f"expected a variant's name that a folder can have, found {variant!r}: use letters alone")
    gains = signed_amplitudes(field).numpy().astype(f"<{np.dtype(precision).str[1:]}")
    if not np.isfinite(gains).all():
        raise ExportError(
            f"expected gains that {precision} holds, up to 65504, found {float(field.sine.abs().max()):.3g}: write "
            "float32"
        )
    picking, places = _packed(
        {
            "means": field.points.numpy().astype("<f4"),
            "scales": shown.log_scales.exp().numpy().astype("<f4"),
            "quaternions": torch.nn.functional.normalize(shown.rotations, dim=1).numpy().astype("<f4"),
            "opacities": shown.opacities.numpy().astype("<f4"),
        }
    )
    modal, tensors = _packed(
        {
            "frequencies": field.frequency.numpy().astype("<f4"),
            "gains": gains,
            "dampings": field.damping.numpy().astype("<f4"),
        }
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
    sizes = write_folder(Path(folder), fill, {**manifest, "variants": [variant]}, force=force)
    remarks = ["every mode starts as a cosine in the demo, of the loudness that it has in the field"]
    if field.noise.any():
        remarks.append("the noise beside the modes is left out, of which the demo knows nothing")
    written = torch.from_numpy(gains.astype(np.float32))
    error = deviation(field, sine=None, cosine=written, damping=field.damping)
    return Written(sizes, tuple(remarks), error)


def read_demo(folder: str | Path, *, variant: str | None = None, sample_rate: float | None = None) -> Demo:
    """Read a folder of the demo: the named variant, or the only one, at `sample_rate` (Hz) if its manifest has none.

    Modes at half the sample rate and above are left out. Raises `ExportError`, which names file and array, for a
    folder of another kind, files cut short, and numbers that are none.
    """
    folder = Path(folder)
    top = _manifest(folder)
    count = _number(top, _COUNTS, folder / MANIFEST)
    picked = {
        name: _array(folder / PICKING, top, name, (count, width) if width > 1 else (count,), "float32")
        for name, width in _PICKED.items()
    }
    sound_folder = folder / (_only_variant(folder) if variant is None else variant)
    sound = _manifest(sound_folder)
    described = _described(sound, "frequencies", sound_folder / MANIFEST)
    modes = described["shape"][0] if "shape" in described else _number(sound, _MODES, sound_folder / MANIFEST)
    path = sound_folder / MODAL
    frequency = _array(path, sound, "frequencies", (modes,), "float32")
    gains = _array(path, sound, "gains", (count, modes), _gain_kind(sound, path))
    damping = _array(path, sound, "dampings", _damping_shape(sound, path, count, modes), "float32")
    rate = sound.get("sampleRate", sound.get("sample_rate", sample_rate)) if sample_rate is None else sample_rate
    if not isinstance(rate, int | float) or not rate > 0:
        raise ExportError(f"{sound_folder / MANIFEST}: expected a sample rate, found {rate!r}: give it, in Hz")
    if not (frequency > 0).all() or not (damping >= 0).all():
        raise ExportError(f"{path}: expected frequencies above 0 and dampings from 0, found others: export it again")
    seconds = sound.get("duration", 3.0)
    if not isinstance(seconds, int | float) or not 0 < seconds < math.inf:
        raise ExportError(f"{sound_folder / MANIFEST}: expected a duration in seconds, found {seconds!r}: mend it")
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


def is_demo(folder: Path) -> bool:
    """Return whether this looks like a folder of the demo."""
    return (folder / MANIFEST).is_file() and (folder / PICKING).is_file()


def discs(field: SampledField) -> GaussianCloud:
    """Return a flat grey Gaussian at each point, along the surface, as wide as the points lie apart."""
    places = field.points.double().numpy()
    if len(places) > 1:
        apart = np.median(cKDTree(places).query(places, k=min(4, len(places)))[0][:, 1:], axis=1)
    else:
        apart = np.ones(1) * 0.01
    width = torch.from_numpy(np.maximum(apart, 1e-6)).float() * 0.6
    scales = torch.stack([width, width, 0.1 * width], dim=1)
    # The turn that brings the third axis onto the normal, half way between the two.
    turned = torch.cat([1.0 + field.normals[:, 2:], -field.normals[:, 1:2], field.normals[:, :1]], dim=1)
    turned = torch.cat([turned, torch.zeros(len(field), 1)], dim=1)
    below = field.normals[:, 2] < -1 + 1e-6
    turned[below] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    return GaussianCloud(
        field.points.float(),
        torch.nn.functional.normalize(turned, dim=1),
        scales.log(),
        torch.full((len(field),), 3.0),
        torch.full((len(field), 1, 3), (_GREY - 0.5) / ZEROTH),
    )


def _seconds(field: SampledField) -> float:
    return field.samples / field.sample_rate


def _packed(arrays: Mapping[str, Shaped[np.ndarray, "..."]]) -> tuple[bytes, dict[str, dict[str, Any]]]:
    """Return arrays one after another, each at a multiple of four bytes, and where each is."""
    content, places = b"", {}
    for name, array in arrays.items():
        content += b"\0" * (-len(content) % 4)
        places[name] = {"offset": len(content), "dtype": array.dtype.name, "shape": list(array.shape)}
        content += array.tobytes()
    return content, places


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    try:
        found = json.loads(path.read_text())
    except OSError as error:
        raise ExportError(
            f"{path}: expected the manifest of the paper's demo, found none ({error.strerror or error}): name a folder "
            "that holds one"
        ) from error
    except ValueError as error:
        raise ExportError(f"{path}: expected JSON, found something else ({error}): export it again") from error
    if not isinstance(found, dict):
        raise ExportError(f"{path}: expected a JSON object, found {type(found).__name__}: export it again")
    return found


def _number(manifest: Mapping[str, Any], names: tuple[str, ...], path: Path) -> int:
    value = next((manifest[name] for name in names if name in manifest), None)
    if not isinstance(value, int) or value < 1:
        raise ExportError(f"{path}: expected {names[0]!r} as a whole number from 1, found {value!r}: mend it")
    return value


def _described(manifest: Mapping[str, Any], name: str, path: Path) -> dict[str, Any]:
    """Return where an array is: its offset in bytes alone, or a record of it, at the top or in a group."""
    groups = [manifest, *(manifest[key] for key in ("arrays", "offsets", "buffers") if key in manifest)]
    for group in groups:
        if isinstance(group, Mapping) and name in group:
            found = group[name]
            record = {"offset": found} if isinstance(found, int) else found
            if isinstance(record, dict):
                record = {**record, "offset": record.get("offset", record.get("byteOffset"))}
                if isinstance(record["offset"], int) and record["offset"] >= 0:
                    return record
            raise ExportError(f"{path}: expected the offset of {name!r} in bytes, found {found!r}: mend it")
    raise ExportError(f"{path}: expected where {name!r} begins, found {', '.join(manifest) or 'nothing'}: mend it")


def _array(
    path: Path, manifest: Mapping[str, Any], name: str, shape: tuple[int, ...], kind: str
) -> Shaped[np.ndarray, "..."]:
    described = _described(manifest, name, path.with_name(MANIFEST))
    if tuple(described.get("shape", shape)) not in (shape, (*shape, 1)):
        raise ExportError(
            f"{path.with_name(MANIFEST)}: expected {name!r} of shape {list(shape)}, found {described['shape']}: "
            "the two manifests belong to different objects"
        )
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ExportError(f"{path}: cannot be read ({error.strerror or error}): export it again") from error
    layout = np.dtype(kind).newbyteorder("<")
    needed = described["offset"] + layout.itemsize * math.prod(shape)
    if needed > len(content):
        raise ExportError(f"{path}: {name!r} ends at byte {needed} of {len(content)}: it was cut short, copy it again")
    values = np.frombuffer(content, layout, math.prod(shape), described["offset"]).reshape(shape)
    wrong = np.argwhere(~np.isfinite(values))
    if len(wrong):
        raise ExportError(
            f"{path}: expected finite numbers in {name!r}, found {values[tuple(wrong[0])]} in row {wrong[0][0]}: "
            "export it again"
        )
    return values


def _gain_kind(sound: Mapping[str, Any], path: Path) -> str:
    described = _described(sound, "gains", path.with_name(MANIFEST))
    kind = described.get("dtype", sound.get("gains_dtype", sound.get("gainsDtype", "float32")))
    if kind not in ("float16", "float32"):
        raise ExportError(f"{path.with_name(MANIFEST)}: expected gains in float16 or float32, found {kind!r}")
    return str(kind)


def _damping_shape(sound: Mapping[str, Any], path: Path, count: int, modes: int) -> tuple[int, ...]:
    """Return the dampings' shape: as it is written, or a row a Gaussian if the file is long enough for that."""
    described = _described(sound, "dampings", path.with_name(MANIFEST))
    if "shape" in described:
        return (count, modes) if len(described["shape"]) == 2 else (modes,)
    others = [_described(sound, name, path)["offset"] for name in ("frequencies", "gains")]
    behind = min([offset for offset in others if offset > described["offset"]], default=0)
    length = (behind or (path.stat().st_size if path.is_file() else 0)) - described["offset"]
    return (count, modes) if length >= 4 * count * modes and count > 1 else (modes,)


def _only_variant(folder: Path) -> str:
    found = sorted(path.parent.name for path in folder.glob(f"*/{MODAL}"))
    if len(found) != 1:
        names = ", ".join(found) or "none"
        raise ExportError(f"{folder}: expected one variant, a folder with {MODAL}, found {names}: name one of them")
    return found[0]
