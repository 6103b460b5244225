"""Recasting against fresh finite-element solves of the same shape in the new material, and in another size."""

import math
import time
from dataclasses import replace

import torch
from torch import Tensor

from avmsf.field.soundfield import Origin, SoundField
from avmsf.field.thinplategains import ThinPlateGains
from avmsf.modal.bank import ModalBank
from avmsf.modal.residual import Residual
from avmsf.simulate.elastic import ElasticModes, elastic_modes
from avmsf.simulate.material import CERAMIC, GLASS, IRON, PLASTIC, STEEL, WOOD, Material
from avmsf.simulate.solid import Solid
from avmsf.simulate.vibration import rayleigh
from avmsf.tasks.recast import recast
from benchmarks.fem import bowl
from benchmarks.report import Options, Report, Table, tell

PAIRS = ((CERAMIC, WOOD, 1.0), (GLASS, STEEL, 1.0), (WOOD, GLASS, 1.0), (IRON, PLASTIC, 0.5), (CERAMIC, CERAMIC, 2.0))
"""Old material, new material, and the new size over the old one."""
CONVENTIONS = (
    "recast.frequency_error: largest relative error of damped frequencies, recast.gain_error: of gains over the "
    "largest of all, between a recast field and a field from a new finite-element solve of the same tetrahedra in the "
    "new material and size, Poisson's ratio kept; ring_error: largest relative error of dampings. A ceramic bowl, a "
    "square of 120 mm and 4 mm thick bent onto a sphere of 100 mm; gains are the displacement of one place by a blow "
    "of a newton-second at each of 24, and are kept as float32.",
    "recast.seconds: time of one recast; recast.solve_seconds: of one solve, which it saves.",
)


def recast_report(options: Options) -> Report:
    """Return both errors over all pairs of materials, and what either way takes."""
    solid = bowl(6 if options.quick_look else 16)
    count = 12 if options.quick_look else 48
    rows: list[list[str | float]] = []
    for old, new, size in PAIRS:
        kept = replace(new, poisson=old.poisson)
        start, _ = _solved(solid, old, 1.0, count)
        begun = time.perf_counter()
        found = recast(start, old, kept, size=size)
        seconds = time.perf_counter() - begun
        fresh, solve_seconds = _solved(solid, kept, size, count)
        frequency = float((found.bank.frequency / fresh.bank.frequency - 1).abs().max())
        damping = float((found.bank.damping / fresh.bank.damping - 1).abs().max())
        ours, truth = _gains(found), _gains(fresh)
        gain = float((ours - truth).abs().max() / truth.abs().max())
        scaled = "" if size == 1.0 else f", {size:g} times as large"
        rows.append([f"{old.name} to {new.name}{scaled}", frequency, damping, gain, seconds, solve_seconds])
        tell(f"recast: {rows[-1][0]}: frequencies off by {frequency:.2g}, gains by {gain:.2g}")
    columns = ("edit", "frequency_error", "ring_error", "gain_error", "seconds", "solve_seconds")
    # Errors at their worst, times in the mean.
    worst = {
        f"recast.{name}": max(float(row[place]) for row in rows) for place, name in enumerate(columns) if 1 <= place < 4
    }
    spent = {
        f"recast.{name}": sum(float(row[place]) for row in rows) / len(rows)
        for place, name in enumerate(columns)
        if place > 3
    }
    title = f"recast: {count} modes of a bowl with {len(solid.cells)} tetrahedra"
    return Report(CONVENTIONS, (Table(title, columns, rows),), {**worst, **spent})


def _solved(solid: Solid, material: Material, size: float, count: int) -> tuple[SoundField, float]:
    """Return the field of a fresh solve of the scaled solid, exact at some corners of its surface, and its seconds."""
    begun = time.perf_counter()
    body = elastic_modes(Solid.build(size * solid.points, solid.cells), material, count=count)
    seconds = time.perf_counter() - begun
    places = size * _places(solid)
    values = torch.stack([_response(body, material, places), torch.zeros(len(places), count).double()], dim=2)
    damping = rayleigh(body.frequency, material) / 2
    frequency = torch.sqrt(body.frequency.square() - (damping / (2 * math.pi)).square())
    field = SoundField(
        ModalBank(frequency, damping),
        ThinPlateGains(places.float(), places, values, 0.0),
        torch.zeros_like(frequency),
        Residual(torch.zeros(9)),
        192e3,
        1000,
        Origin("bowl"),
    )
    return field, seconds


def _response(body: ElasticModes, material: Material, places: Tensor) -> Tensor:
    """Return displacements of the first place in each mode, by blows of a newton-second at all, straight down."""
    down = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand(len(places), 3)
    shapes = body.gains(places, down)
    damping = rayleigh(body.frequency, material) / 2
    return shapes * shapes[:1] / torch.sqrt((2 * math.pi * body.frequency).square() - damping.square())


def _places(solid: Solid) -> Tensor:
    corners = torch.unique(solid.boundary)
    return solid.points[corners[:: math.ceil(len(corners) / 24)]]


def _gains(field: SoundField) -> Tensor:
    return field.gains(field.gain_field.points).double()
