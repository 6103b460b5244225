"""The layout of the paper's web demo: Gaussians to pick, and a gain of every mode at each of them.

A folder holds `manifest.json` and `picking.bin` (float32, little endian, one array after another: means [N, 3], scales
[N, 3], quaternions [N, 4] as w x y z, opacities [N]), `scene.ply` with the same Gaussians, and one folder for each
variant of the sound with its own `manifest.json` and `modal.bin`: frequencies [M] in Hz, gains [N, M] in float16 or
float32, dampings [M] or [N, M] in 1/s. The demo's player starts every mode as a cosine and knows no noise.
"""

import json
from pathlib import Path

import numpy as np
import torch

from avmsf.errors import ExportError
from avmsf.export.one_phase import approximation_error, signed_amplitudes
from avmsf.export.sampled_field import SampledField
from avmsf.export.writing import MANIFEST, Precision, Written, generator, pack, write_folder
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.initialize import StartPoints, starting_cloud
from avmsf.gaussians.ply import splat_bytes

PICKING, SCENE, MODAL = "picking.bin", "scene.ply", "modal.bin"


def write_demo(
    field: SampledField,
    folder: str | Path,
    *,
    cloud: GaussianCloud | None = None,
    variant: str = "original",
    precision: Precision = "float32",
    overwrite: bool = False,
) -> Written:
    """Write the demo's folder; where there is no `cloud` whose centers are the field's points, with a disc at each.

    Modes have the field's level and start as cosines, whatever their phase is in the field. With `overwrite`, other
    variants of the same Gaussians stay in the folder. Raises `ExportError`, also where it holds variants of others, and
    without a `cloud` `SceneError` for fewer than four points.
    """
    folder, shown = Path(folder), cloud
    if shown is None:
        # A flat gray Gaussian at each point, tangent to the surface, as wide as the distance between points.
        start = StartPoints(field.points, torch.full_like(field.points, 0.7), field.normals)
        shown = starting_cloud(start, degree=0, scale=0.6, opacity=0.95, flatness=0.1)
    if len(shown) != len(field):
        wanted, advice = f"one for each of {len(field)} points", "sample the field at the Gaussians' centers"
        raise ExportError.expected(wanted, len(shown), name="cloud", advice=advice)
    if not variant or Path(variant).name != variant or variant.startswith("."):
        raise ExportError.expected("a name that a folder can have", variant, name="variant", advice="use letters")
    amplitudes = signed_amplitudes(field)
    gains = amplitudes.numpy().astype(f"<{np.dtype(precision).str[1:]}")
    if not np.isfinite(gains).all():
        loudest = float(amplitudes.abs().max())
        wanted, got = f"gains up to 65504 for {precision}", f"{loudest:.3g}"
        raise ExportError.expected(wanted, loudest, got=got, name="precision", advice="take float32")
    means, rotations = field.points, torch.nn.functional.normalize(shown.rotations, dim=1)
    drawn = {"means": means, "scales": shown.log_scales.exp(), "quaternions": rotations, "opacities": shown.opacities}
    picking, places = pack({name: array.numpy().astype("<f4") for name, array in drawn.items()})
    frequency, damping = (array.numpy().astype("<f4") for array in (field.frequency, field.damping))
    modal, tensors = pack({"frequencies": frequency, "gains": gains, "dampings": damping})
    sound = {
        "generator": generator(),
        "file": MODAL,
        "modes": len(field.frequency),
        "duration": field.samples / field.sample_rate,
        "sampleRate": field.sample_rate,
        "phase": "cosine",
        "arrays": tensors,
    }
    others = _other_variants(folder, variant, picking)
    files = {PICKING: picking, SCENE: splat_bytes(shown), **others, f"{variant}/{MODAL}": modal}
    files[f"{variant}/{MANIFEST}"] = (json.dumps(sound, indent=1) + "\n").encode()
    variants = sorted({path.partition("/")[0] for path in files if "/" in path})
    manifest = {"name": field.name, "count": len(field), "file": PICKING, "arrays": places, "scene": SCENE}
    sizes = write_folder(folder, files, {**manifest, "variants": variants}, overwrite=overwrite)
    written = torch.from_numpy(gains.astype(np.float32))
    remarks = ["every mode starts as a cosine in the demo, with the field's level"]
    if field.noise.any():
        remarks.append("the residual noise is left out, since the demo has none")
    if others:
        left = ", ".join(name for name in variants if name != variant)
        remarks.append(f"the folder's other variants are unchanged: {left}")
    error = approximation_error(field, torch.complex(torch.zeros_like(written), written), field.damping)
    return Written(sizes, tuple(remarks), *error)


def _other_variants(folder: Path, variant: str, picking: bytes) -> dict[str, bytes]:
    """Return the files of a folder's other variants. Raises `ExportError` where they are of other Gaussians."""
    try:
        names = sorted({path.parent.name for path in folder.glob(f"*/{MODAL}")} - {variant})
        if names and not ((folder / PICKING).is_file() and (folder / PICKING).read_bytes() == picking):
            wanted = "a free name, or variants of the same Gaussians,"
            raise ExportError.expected(wanted, names, file=folder, advice="choose another folder")
        paths = [path for name in names for path in (folder / name).rglob("*") if path.is_file()]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
    except OSError as error:
        reason = error.strerror or str(error)
        raise ExportError.expected("a readable folder", reason, file=folder, advice="choose another folder") from error
