"""What the exports weigh and how near their own readers come to the field."""

import json
import math
import resource
import shutil
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from avmsf.export.faust import write_faust
from avmsf.export.gltf import write_gltf
from avmsf.export.paper_demo import write_demo
from avmsf.export.sampled_field import SampledField
from avmsf.export.samples import write_grid
from avmsf.export.uff import write_universal
from benchmarks.report import Options, Report, Table, log

DRIVER = Path(__file__).resolve().parents[1] / "tests" / "export" / "faust_driver.c"
CONVENTIONS = (
    "a field of 128 modes from 80 Hz to 15 kHz that ring for .1 to 1 s, drawn at random at 1000 points, 44.1 kHz, 3 s; "
    "sines and no noise for glTF and the demo, whose formats hold no other, phases and noise for Faust.",
    "errors: largest difference between what a reader of the file, who knows the format alone, hears and "
    "SampledField.render, "
    "over the loudest sample of each blow, the worst of several. glTF and the demo hold frequencies as float32, which "
    "is most of theirs; Faust compiled in double precision, single: as it compiles unless told otherwise.",
    "the demo plays every mode as a cosine: its error is against the field with cosines of the same size, its waveform "
    "error against the field as it is.",
)


def measure(options: Options) -> Report:
    """Return both parts' figures."""
    points, seconds = (20, 0.2) if options.quick_look else (1000, 3.0)
    report = Report(CONVENTIONS)
    for part in options.parts or tuple(PARTS):
        report += PARTS[part](drawn_field(points, seconds=seconds))
    return report


def drawn_field(points: int, *, modes: int = 128, seconds: float, rate: float = 44100.0) -> SampledField:
    """Return a field with phases and noise, drawn at random."""
    draw = torch.Generator().manual_seed(0)
    places = torch.randn(points, 3, generator=draw)
    normals = torch.nn.functional.normalize(places, dim=1)
    frequency = 80 * (15_000 / 80) ** torch.linspace(0, 1, modes, dtype=torch.float64)
    return SampledField(
        0.1 * normals,
        normals,
        frequency,
        6.9 * 10 ** torch.rand(modes, generator=draw, dtype=torch.float64),
        torch.complex(torch.randn(points, modes, generator=draw), 0.5 * torch.randn(points, modes, generator=draw)),
        0.02 * torch.randn(round(seconds * rate), generator=draw),
        rate,
        name="drawn",
    )


def _exports(field: SampledField) -> Report:
    plain = replace(field, gains=field.gains.real + 0j, noise=torch.zeros_like(field.noise))
    rows = field.spread(4)
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        log("studio: exports")
        weights = {
            "gltf": write_gltf(plain, place / "field.glb"),
            "demo": write_demo(plain, place / "demo"),
            "wavs": write_grid(field.take(field.spread(16)), place / "wavs"),
            "uff": write_universal(field, place / "field.uff"),
        }
        found["export.gltf_error"] = _worst(_gltf_sounds(place / "field.glb", plain, rows), plain, rows)
        turned = replace(plain, gains=1j * plain.gains)
        heard = _demo_sounds(place / "demo", plain, rows)
        found["export.demo_error"] = _worst(heard, turned, rows)
        found["export.demo_waveform_error"] = _worst(heard, plain, rows)
        few = field.take(field.spread(64))
        weights["faust"] = write_faust(few, place / "field.dsp")
        found |= _faust(few, place)
    for name, written in weights.items():
        found[f"export.{name}_megabytes"] = written.size / 1e6
    title = f"exports of {len(field)} points ({len(few)} for Faust, 16 for wavs), {len(field.frequency)} modes"
    table: list[list[str | float]] = [
        [name, _error(found, name), written.size / 1e6] for name, written in weights.items()
    ]
    return Report(tables=(Table(title, ("format", "error", "MB"), table),), figures=found)


def _error(found: dict[str, float], name: str) -> float:
    return found.get(f"export.{name}_error", math.nan)


def _worst(heard: np.ndarray, field: SampledField, rows: torch.Tensor) -> float:
    true = field.render(rows).double().numpy()
    return float((np.abs(heard - true).max(1) / np.abs(true).max(1)).max())


def _gltf_sounds(path: Path, field: SampledField, rows: torch.Tensor) -> np.ndarray:
    """Return what the draft says of an impulse into the surface, read by container, accessors and formula alone."""
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    model = document["extensions"]["KHR_audio_rigid_bodies"]["modalModels"][0]

    def numbers(name: str) -> np.ndarray:
        accessor = document["accessors"][model[name]]
        view = document["bufferViews"][accessor["bufferView"]]
        values = np.frombuffer(content, "<f4", view["byteLength"] // 4, 28 + length + view["byteOffset"])
        return values.astype(np.float64)

    frequency, decay = numbers("frequencies"), numbers("decayRates")
    shapes = numbers("shapes").reshape(len(frequency), -1, 3)
    times = np.arange(field.samples) / field.sample_rate
    sounds = np.zeros((len(rows), field.samples))
    for m in range(len(frequency)):
        wave = np.exp(-decay[m] * times) * np.sin(2 * np.pi * frequency[m] * times)
        for number, row in enumerate(rows.tolist()):
            push = float(shapes[m, row] @ -field.normals[row].double().numpy())
            sounds[number] += 2 * np.pi * frequency[m] * push * wave
    return sounds


def _demo_sounds(folder: Path, field: SampledField, rows: torch.Tensor) -> np.ndarray:
    """Return what the demo's player makes of the folder: cosines, by offsets and counts alone."""
    sound = json.loads((folder / "original" / "manifest.json").read_text())
    content = (folder / "original" / "modal.bin").read_bytes()

    def numbers(name: str) -> np.ndarray:
        place = sound["arrays"][name]
        count = math.prod(place["shape"])
        return np.frombuffer(content, "<f4", count, place["offset"]).reshape(place["shape"]).astype(np.float64)

    frequency, gains, damping = numbers("frequencies"), numbers("gains"), numbers("dampings")
    times = np.arange(field.samples) / field.sample_rate
    sounds = np.zeros((len(rows), field.samples))
    for m in range(len(frequency)):
        wave = np.exp(-damping[m] * times) * np.cos(2 * np.pi * frequency[m] * times)
        sounds += gains[rows.numpy(), m][:, None] * wave
    return sounds


def _faust(field: SampledField, place: Path) -> dict[str, float]:
    """Return the compiled program's error in both precisions and how long Faust took; nothing where it is missing."""
    if shutil.which("faust") is None or shutil.which("gcc") is None:
        log("studio: no faust or no gcc here, its error is not measured")
        return {}
    found = {}
    for key, flag, real in (("faust_error", "-double", "double"), ("faust_error_single", "-single", "float")):
        begun = time.process_time() + _children()
        source, program = place / "field.c", place / "field"
        subprocess.run(["faust", "-lang", "c", flag, "-a", DRIVER, "-o", source, place / "field.dsp"], check=True)
        found["export.faust_seconds"] = time.process_time() + _children() - begun
        subprocess.run(["gcc", "-O1", "-w", f"-DREAL={real}", "-o", program, source, "-lm"], check=True)
        row = len(field) - 1
        words = [f"{field.sample_rate:.0f}", str(field.samples), str(row), "1", "0", "0"]
        heard = np.frombuffer(subprocess.run([program, *words], check=True, capture_output=True).stdout)
        found[f"export.{key}"] = _worst(heard[None], field, torch.tensor([row]))
    return found


def _children() -> float:
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime


PARTS: dict[str, Callable[[SampledField], Report]] = {"exports": _exports}
