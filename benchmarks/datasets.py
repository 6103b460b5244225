"""What opening one object of RealImpact costs, on a file of full size: time and memory, in a process of its own."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from benchmarks.report import Options, Report, Table, log

NAME = "43_IronMortar"
_CHILD = """
import json, resource, sys, time, warnings
from avmsf.errors import CaptureWarning
from avmsf.datasets import open_dataset
from benchmarks.step import peak_gigabytes

warnings.simplefilter("ignore", CaptureWarning)

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 2**20

before = resident()
begun, begun_cpu = time.perf_counter(), time.process_time()
capture = open_dataset(sys.argv[1]).capture(sys.argv[2])
seconds, cpu = time.perf_counter() - begun, time.process_time() - begun_cpu
peak = peak_gigabytes() * 1e9 / 2**20
found = {"seconds": seconds, "cpu": cpu, "megabytes": peak - before, "peak": peak, "blows": len(capture.impacts)}
print(json.dumps(found))
"""


def measure_realimpact(options: Options) -> Report:
    """Return what the capture of one object takes, of 3,000 sounds of 222,000 samples and a mesh of 41,000 vertices."""
    samples, subdivisions = (4800, 3) if options.quick_look else (222_000, 6)
    with tempfile.TemporaryDirectory(prefix="realimpact-") as place:
        size = write_object(Path(place), samples=samples, subdivisions=subdivisions)
        command = [sys.executable, "-c", _CHILD, place, NAME]
        ran = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    found = json.loads(ran.stdout.splitlines()[-1])
    log(f"realimpact: {found['blows']} blows in {found['seconds']:.2f} s, {found['megabytes']:.0f} MB")
    figures = {
        "realimpact.open_seconds": found["seconds"],
        "realimpact.cpu_seconds": found["cpu"],
        "realimpact.megabytes": found["megabytes"],
    }
    convention = (
        f"realimpact: one object of {size / 1e9:.2f} GB (sparse: the sounds of far microphones are holes) with a "
        "textured mesh, in a fresh process. open_seconds: from the folder's name to the Capture, after imports; "
        "cpu_seconds: what of it the process worked. megabytes: the process's peak resident memory (VmHWM) less "
        "what was resident before, in units of 2^20; pages of the mapped file that were looked at count."
    )
    rows = [*figures.items(), ("peak of the process, megabytes", found["peak"])]
    return Report((convention,), (Table("realimpact", ("figure", "value"), rows),), figures)


def write_object(folder: Path, *, samples: int, subdivisions: int) -> int:
    """Write an object in RealImpact's layout and return its sounds' size, bytes."""
    home = folder / NAME / "preprocessed"
    home.mkdir(parents=True)
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.08)
    mesh.apply_translation((0.013, 0.047, 0.21))
    across = np.asarray(mesh.vertices)[:, :2]
    picture = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8).repeat(16, 0).repeat(16, 1)
    paint = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(picture))  # type: ignore[no-untyped-call]
    uv = (across - across.min(0)) / np.ptp(across, axis=0)
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=paint)  # type: ignore[no-untyped-call]
    mesh.export(home / "transformed.obj")
    angle, distance, height = (
        grid.ravel() for grid in np.meshgrid(np.arange(0, 181, 20), (0, 333, 667, 1000), np.arange(15), indexing="ij")
    )
    turn, reach = np.radians(angle), (230 + distance) / 1000
    listeners = np.stack([reach * np.cos(turn), reach * np.sin(turn), -0.91 + 1.82 * height / 14], axis=1)
    vertices = np.linspace(0, len(mesh.vertices) - 1, 5).astype(np.int64)
    np.save(home / "vertexID.npy", vertices.repeat(600))
    np.save(home / "vertexXYZ.npy", np.asarray(mesh.vertices)[vertices].repeat(600, axis=0))
    np.save(home / "listenerXYZ.npy", np.tile(listeners, (5, 1)))
    for name, values in (("angle", angle), ("distance", distance), ("micID", height)):
        np.save(home / f"{name}.npy", np.tile(values, 5).astype(np.int64))
    path = home / "deconvolved_0db.npy"
    sounds = np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=(3000, samples))
    ring = np.exp(-np.arange(samples) / 4800) * np.sin(0.2 * np.arange(samples) + 1)
    # Whichever microphone is the closest, it stands in the arm's nearest place: these rows are written, others are not.
    for row in np.flatnonzero(np.tile(distance == 0, 5)):
        sounds[row, :4800] = ring[:4800]
        if height[row % 600] in (8, 9):
            sounds[row] = ring
    sounds.flush()
    return path.stat().st_size
