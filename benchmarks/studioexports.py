"""What the exports weigh and how near their own readers come to the field."""

import json
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from avmsf.export.faust import write_faust
from avmsf.export.gltf import write_gltf
from avmsf.export.paper_demo import write_demo
from avmsf.export.sampled_field import SampledField
from avmsf.export.samples import write_grid
from avmsf.export.uff import write_universal
from benchmarks.processes import processor_seconds
from benchmarks.records import REPOSITORY, Record, Settings, records
from tests.factories.made_tables import read_arrays

DRIVER = REPOSITORY / "tests" / "export" / "faust_driver.c"
_MODES, _RATE = 128, 44100.0
Array = Float64[np.ndarray, "..."]


def exports(settings: Settings) -> Iterator[Record]:
    """Largest difference between what a reader of the file, who knows the format alone, hears and the field's render.

    Over the loudest sample of each impact, the worst of several. A field of 128 modes from 80 Hz to 15 kHz that ring
    for .1 to 1 s, drawn at random at 1000 points (Faust: 64, wavs: 16), 44.1 kHz, 3 s; sines and no noise for glTF and
    the demo, whose formats hold no other, phases and noise for Faust. glTF and the demo hold frequencies as float32,
    which is most of their error; Faust compiled in double precision, single: as it compiles by default. The
    demo plays every mode as a cosine: its error is against the field with cosines of the same size, its waveform error
    against the field as it is.
    """
    points, seconds = (20, 0.2) if settings.quick else (1000, 3.0)
    field = _drawn_field(points, seconds=seconds)
    plain = replace(field.without_noise(), gains=field.gains.real + 0j)
    few, rows = field.take(field.spread(64)), field.spread(4)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        megabytes = {
            "gltf": write_gltf(plain, folder / "field.glb").size,
            "demo": write_demo(plain, folder / "demo").size,
            "wavs": write_grid(field.take(field.spread(16)), folder / "wavs").size,
            "uff": write_universal(field, folder / "field.uff").size,
            "faust": write_faust(few, folder / "field.dsp").size,
        }
        heard = _demo_sounds(folder / "demo", plain, rows)
        errors = {
            "gltf": {"error": _worst(_gltf_sounds(folder / "field.glb", plain, rows), plain, rows)},
            "demo": {
                "error": _worst(heard, replace(plain, gains=1j * plain.gains), rows),
                "waveform_error": _worst(heard, plain, rows),
            },
            "faust": _faust(few, folder),
        }
    for kind, size in megabytes.items():
        yield from records({"megabytes": size / 1e6}, object=kind)
    for kind, values in errors.items():
        yield from records(values, group=kind)


def _drawn_field(points: int, *, seconds: float) -> SampledField:
    """Return a field with phases and noise, drawn at random."""
    draw = torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(points, 3, generator=draw), dim=1)
    frequency = 80 * (15_000 / 80) ** torch.linspace(0, 1, _MODES, dtype=torch.float64)
    damping = 6.9 * 10 ** torch.rand(_MODES, generator=draw, dtype=torch.float64)
    sines, cosines = torch.randn(points, _MODES, generator=draw), 0.5 * torch.randn(points, _MODES, generator=draw)
    noise = 0.02 * torch.randn(round(seconds * _RATE), generator=draw)
    gains = torch.complex(sines, cosines)
    return SampledField(0.1 * normals, normals, frequency, damping, gains, noise, _RATE, name="drawn")


def _worst(heard: Array, field: SampledField, rows: torch.Tensor) -> float:
    true = field.render(rows).double().numpy()
    return float((np.abs(heard - true).max(1) / np.abs(true).max(1)).max())


def _summed(
    field: SampledField, gains: Array, frequency: Array, damping: Array, wave: Callable[[Array], Array]
) -> Array:
    """Return the sounds of modes with these gains [sounds, modes], by the textbook's formula in double precision."""
    times = np.arange(field.samples) / field.sample_rate
    sounds = np.zeros((len(gains), field.samples))
    for mode in range(len(frequency)):
        decaying = np.exp(-damping[mode] * times) * wave(2 * np.pi * frequency[mode] * times)
        sounds += gains[:, mode, None] * decaying
    return sounds


def _gltf_sounds(path: Path, field: SampledField, rows: torch.Tensor) -> Array:
    """Return what the draft says of an impulse into the surface, read by container, accessors and formula alone."""
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    model = document["extensions"]["KHR_audio_rigid_bodies"]["modalModels"][0]

    def numbers(name: str) -> Array:
        view = document["bufferViews"][document["accessors"][model[name]]["bufferView"]]
        values = np.frombuffer(content, "<f4", view["byteLength"] // 4, 28 + length + view["byteOffset"])
        return values.astype(np.float64)

    frequency = numbers("frequencies")
    shapes = numbers("shapes").reshape(len(frequency), -1, 3)[:, rows.numpy()]
    pushes = np.einsum("mrd,rd->rm", shapes, -field.normals[rows].double().numpy())
    return _summed(field, 2 * np.pi * frequency * pushes, frequency, numbers("decayRates"), np.sin)


def _demo_sounds(folder: Path, field: SampledField, rows: torch.Tensor) -> Array:
    """Return what the demo's player makes of the folder: cosines, by offsets and counts alone."""
    arrays = {name: array.double().numpy() for name, array in read_arrays(folder / "original").items()}
    return _summed(field, arrays["gains"][rows.numpy()], arrays["frequencies"], arrays["dampings"], np.cos)


def _faust(field: SampledField, folder: Path) -> dict[str, float]:
    """Return the compiled program's error in both precisions and how long Faust took; nothing where it is missing."""
    if shutil.which("faust") is None or shutil.which("gcc") is None:
        return {}
    found = {}
    for key, flag, real in (("error", "-double", "double"), ("error_single", "-single", "float")):
        begun = processor_seconds()
        source, program, row = folder / "field.c", folder / "field", len(field) - 1
        subprocess.run(["faust", "-lang", "c", flag, "-a", DRIVER, "-o", source, folder / "field.dsp"], check=True)
        found["seconds"] = processor_seconds() - begun
        subprocess.run(["gcc", "-O1", "-w", f"-DREAL={real}", "-o", program, source, "-lm"], check=True)
        words = [f"{field.sample_rate:.0f}", str(field.samples), str(row), "1", "0", "0"]
        heard = np.frombuffer(subprocess.run([program, *words], check=True, capture_output=True).stdout)
        found[key] = _worst(heard[None], field, torch.tensor([row]))
    return found
