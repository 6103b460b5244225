"""The layout of the paper's web demo: Gaussians to pick, and a gain of every mode at each of them.

A folder holds `manifest.json` and `picking.bin` (float32, little endian, one array after another: means [N, 3], scales
[N, 3], quaternions [N, 4] as w x y z, opacities [N]), `scene.ply` with the same Gaussians, and a folder for the sound
with its own `manifest.json` and `modal.bin`: frequencies [M] in Hz, gains [N, M] in float16 or float32, dampings [M] or
[N, M] in 1/s. The demo's player starts every mode as a cosine and knows no noise.
"""

import json
from pathlib import Path

import numpy as np
import torch

from avmsf.errors import ExportError
from avmsf.export.sampled_field import SampledField, approximation_error, signed_amplitudes
from avmsf.export.writing import MANIFEST, Precision, Written, generator, pack, write_folder
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import splat_bytes
from avmsf.gaussians.start_points import StartPoints, starting_cloud

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

    Modes have the field's level and start as cosines, whatever their phase is in the field. Raises `ExportError`, and
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
    files = {PICKING: picking, SCENE: splat_bytes(shown), f"{variant}/{MODAL}": modal}
    files[f"{variant}/{MANIFEST}"] = (json.dumps(sound, indent=1) + "\n").encode()
    manifest = {"name": field.name, "count": len(field), "file": PICKING, "arrays": places, "scene": SCENE}
    sizes = write_folder(folder, files, {**manifest, "variants": [variant]}, overwrite=overwrite)
    written = torch.from_numpy(gains.astype(np.float32))
    remarks = ["every mode starts as a cosine in the demo, with the field's level"]
    if field.noise.any():
        remarks.append("the residual noise is left out, since the demo has none")
    error = approximation_error(field, torch.complex(torch.zeros_like(written), written), field.damping)
    return Written(sizes, tuple(remarks), *error)
