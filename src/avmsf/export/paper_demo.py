"""The layout of the paper's web demo: Gaussians to pick, and a gain of every mode at each of them.

A folder holds `manifest.json` and `picking.bin` (float32, little endian, one array after another: means [N, 3], scales
[N, 3], quaternions [N, 4] as w x y z, opacities [N]), `scene.ply` with the same Gaussians, and one folder for each
variant of the sound with its own `manifest.json` and `modal.bin`: frequencies [M] in Hz, gains [N, M] in float16 or
float32, dampings [M] or [N, M] in 1/s. The demo's player starts every mode as a cosine and knows no noise.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from avmsf.errors import ExportError
from avmsf.export.formats import Precision
from avmsf.export.one_phase import approximation_error, signed_amplitudes
from avmsf.export.sampled_field import SampledField
from avmsf.export.writing import MANIFEST, Written, generator, pack, write_folder
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.initialize import StartPoints, starting_cloud
from avmsf.gaussians.ply import write_splats

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

    Modes have the field's level and start as cosines, whatever their phase is in the field. With `force`, other
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
    gains = _gains(field, precision)
    picking, places = _picking(field, shown)
    frequency, damping = (array.numpy().astype("<f4") for array in (field.frequency, field.damping))
    modal, tensors = pack({"frequencies": frequency, "gains": gains, "dampings": damping})
    others = sorted({path.parent.name for path in folder.glob(f"*/{MODAL}")} - {variant})
    if others and not ((folder / PICKING).is_file() and (folder / PICKING).read_bytes() == picking):
        wanted = "a free name, or variants of the same Gaussians,"
        raise ExportError.expected(wanted, others, file=folder, advice="choose another folder")

    def fill(place: Path) -> None:
        (place / PICKING).write_bytes(picking)
        write_splats(shown, place / SCENE)
        (place / variant).mkdir()
        (place / variant / MODAL).write_bytes(modal)
        sound = {
            "generator": generator(),
            "file": MODAL,
            "modes": len(field.frequency),
            "duration": field.samples / field.sample_rate,
            "sampleRate": field.sample_rate,
            "phase": "cosine",
            "arrays": tensors,
        }
        (place / variant / MANIFEST).write_text(json.dumps(sound, indent=1) + "\n")
        for other in others:
            shutil.copytree(folder / other, place / other)

    manifest = {"name": field.name, "count": len(field), "file": PICKING, "arrays": places, "scene": SCENE}
    sizes = write_folder(folder, fill, {**manifest, "variants": sorted([variant, *others])}, overwrite=overwrite)
    written = torch.from_numpy(gains.astype(np.float32))
    remarks = ["every mode starts as a cosine in the demo, with the field's level"]
    if field.noise.any():
        remarks.append("the residual noise is left out, since the demo has none")
    if others:
        remarks.append(f"the folder's other variants are unchanged: {', '.join(others)}")
    return Written(sizes, tuple(remarks), *approximation_error(field, cosine=written, damping=field.damping))


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
