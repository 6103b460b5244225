"""Changed materials against fresh finite-element solves of the same shape in the new material, and in another size."""

import json
import math
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from avmsf.editing.material import change_material
from avmsf.fem.damping import rayleigh
from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.material import CERAMIC, GLASS, IRON, PLASTIC, STEEL, WOOD, Material
from avmsf.fem.solid import Solid
from avmsf.field.gains.kernels import Sites, Smooth
from avmsf.field.gains.mixture import NOISE_SHARES, KernelMixture
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import series_of
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import save
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from benchmarks.fem import bowl
from benchmarks.report import Options, Report, Table, log

PAIRS = ((CERAMIC, WOOD, 1.0), (GLASS, STEEL, 1.0), (WOOD, GLASS, 1.0), (IRON, PLASTIC, 0.5), (CERAMIC, CERAMIC, 2.0))
"""Old material, new material, and the new size over the old one."""
CONVENTIONS = (
    "change_material.frequency_error: largest relative error of damped frequencies; gain_error: of a mode's gains over "
    "the largest of that mode (modes of one frequency, whose shapes are any mixture, summed), between a changed field "
    "and a field from a new finite-element solve of the same tetrahedra in the new material and size, Poisson's ratio "
    "kept; ring_error: largest relative error of dampings. A ceramic bowl, a "
    "square of 120 mm and 4 mm thick bent onto a sphere of 100 mm; gains are the displacement of one place by a blow "
    "of a newton-second at each of 24, and are kept as float32.",
    "change_material.seconds: time of one change; solve_seconds: of one solve, which it saves. megabytes: what "
    "one change adds to the peak of resident memory (VmHWM) of a process that has loaded the field, in units of 2^20.",
)


_LISTENED = 7
"""Row of the place that moves: on none of the bowl's planes of symmetry, where modes have nodes."""
_CHILD = """
import json, sys
from avmsf.field.store import load
from avmsf.fem.material import CERAMIC, GLASS
from avmsf.editing.material import change_material
from benchmarks.step import peak_gigabytes

field = load(sys.argv[1])
before = peak_gigabytes()
change_material(field, CERAMIC, GLASS)
print(json.dumps((peak_gigabytes() - before) * 1e9 / 2**20))
"""


def changed_material_report(options: Options) -> Report:
    """Return both errors over all pairs of materials, and what either way takes."""
    solid = bowl(6 if options.quick_look else 16)
    count = 12 if options.quick_look else 48
    rows: list[list[str | float]] = []
    for old, new, size in PAIRS:
        kept = replace(new, poisson=old.poisson)
        start, _ = _solved(solid, old, 1.0, count)
        begun = time.perf_counter()
        found = change_material(start, old, kept, size=size)
        seconds = time.perf_counter() - begun
        fresh, solve_seconds = _solved(solid, kept, size, count)
        frequency = float((found.bank.frequency / fresh.bank.frequency - 1).abs().max())
        damping = float((found.bank.damping / fresh.bank.damping - 1).abs().max())
        ours, truth = (_by_pitch(each, fresh.bank.frequency) for each in (_gains(found), _gains(fresh)))
        gain = float(((ours - truth).abs().amax(0) / truth.abs().amax(0)).max())
        scaled = "" if size == 1.0 else f", {size:g} times as large"
        rows.append([f"{old.name} to {new.name}{scaled}", frequency, damping, gain, seconds, solve_seconds])
        log(f"change_material: {rows[-1][0]}: frequencies off by {frequency:.2g}, gains by {gain:.2g}")
    columns = ("edit", "frequency_error", "ring_error", "gain_error", "seconds", "solve_seconds")
    # Errors at their worst, times in the mean.
    worst = {
        f"change_material.{name}": max(float(row[place]) for row in rows)
        for place, name in enumerate(columns)
        if 1 <= place < 4
    }
    spent = {
        f"change_material.{name}": sum(float(row[place]) for row in rows) / len(rows)
        for place, name in enumerate(columns)
        if place > 3
    }
    spent["change_material.megabytes"] = _megabytes(start)
    title = f"change_material: {count} modes of a bowl with {len(solid.cells)} tetrahedra"
    return Report(CONVENTIONS, (Table(title, columns, rows),), {**worst, **spent})


def _megabytes(field: SoundField) -> float:
    """Return what one change adds to the peak of a fresh process's resident memory."""
    with tempfile.TemporaryDirectory(prefix="material-") as place:
        path = Path(place) / "bowl.safetensors"
        save(field, path)
        command = [sys.executable, "-c", _CHILD, str(path)]
        ran = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    return float(json.loads(ran.stdout.splitlines()[-1]))


def _solved(solid: Solid, material: Material, size: float, count: int) -> tuple[SoundField, float]:
    """Return the field of a fresh solve of the scaled solid, through gains at some corners, and its seconds."""
    begun = time.perf_counter()
    body = elastic_modes(Solid.build(size * solid.points, solid.cells), material, count=count)
    seconds = time.perf_counter() - begun
    places = size * _places(solid)
    damping = rayleigh(body.frequency, material) / 2
    frequency = torch.sqrt(body.frequency.square() - (damping / (2 * math.pi)).square())
    field = SoundField(
        ModalBank(frequency, damping),
        _gain_model(places, _response(body, material, places)),
        torch.zeros_like(frequency),
        Residual(torch.zeros(9)),
        192e3,
        1000,
        Origin("bowl"),
    )
    return field, seconds


def _gain_model(places: Tensor, values: Tensor) -> MixtureGains:
    """Return gains of one kernel: linear in the values alike for all modes, so that the model adds no error."""
    sites = Sites(places, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(len(places), 3))
    smooth = Smooth(sites, float((places.amax(0) - places.amin(0)).norm())).take(torch.tensor([0]))
    series = series_of(values.to(torch.complex128))
    weights = torch.zeros(1, len(NOISE_SHARES), series.shape[1], dtype=torch.float64)
    weights[:, 0] = 1.0
    mixture = KernelMixture(smooth.kernels(), series, torch.zeros(series.shape[1], dtype=torch.float64), weights)
    return MixtureGains(places.float(), sites, (smooth,), mixture, directional=False)


def _response(body: ElasticModes, material: Material, places: Tensor) -> Tensor:
    """Return displacements of one place in each mode, by blows of a newton-second at all, straight down."""
    down = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand(len(places), 3)
    shapes = body.gains(places, down)
    damping = rayleigh(body.frequency, material) / 2
    return shapes * shapes[_LISTENED] / torch.sqrt((2 * math.pi * body.frequency).square() - damping.square())


def _places(solid: Solid) -> Tensor:
    corners = torch.unique(solid.boundary)
    return solid.points[corners[:: math.ceil(len(corners) / 24)]]


def _gains(field: SoundField) -> Tensor:
    return field.gains(field.gain_field.points).double()


def _by_pitch(gains: Tensor, frequency: Tensor) -> Tensor:
    """Return gains with modes of one frequency summed, which does not depend on the shapes that stand for them."""
    apart = torch.diff(frequency) > 1e-5 * frequency[:-1]
    group = torch.cat([torch.zeros(1, dtype=torch.long), torch.cumsum(apart.long(), 0)])
    return torch.zeros(len(gains), int(group[-1]) + 1, dtype=gains.dtype).index_add(1, group, gains)
