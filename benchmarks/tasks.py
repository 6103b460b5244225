"""Changed materials against fresh finite-element solves of the same shape in the new material, and in another size."""

import math
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from avmsf.editing.material import change_material
from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.material import CERAMIC, GLASS, IRON, PLASTIC, STEEL, WOOD, Material
from avmsf.fem.solid import Solid
from avmsf.fem.vibration import rayleigh
from avmsf.field.gains.kernels import Sites, Smooth
from avmsf.field.gains.mixture import NOISE_SHARES, KernelMixture
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import series_of
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import load, save
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from benchmarks.processes import apart, peak_gigabytes, timed
from benchmarks.proof import bowl
from benchmarks.records import Measurement, Record, Settings, means, records

PAIRS = ((CERAMIC, WOOD, 1.0), (GLASS, STEEL, 1.0), (WOOD, GLASS, 1.0), (IRON, PLASTIC, 0.5), (CERAMIC, CERAMIC, 2.0))
"""Old material, new material, and the new size over the old one."""
_RESPONSE_NODE = 7
"""Row of the point that moves: on none of the bowl's planes of symmetry, where modes have nodes."""


def change(settings: Settings) -> Iterator[Record]:
    """Largest relative errors of a changed field against a field from a new solve, Poisson's ratio kept.

    frequency_error: of damped frequencies; damping_error; gain_error: of a mode's gains over the largest of that mode
    (modes of one frequency, whose shapes are any mixture, summed). A ceramic bowl, a square of 120 mm and 4 mm thick
    bent onto a sphere of 100 mm; gains are the displacement of one point by an impact of a newton-second at each of 24,
    kept as float32. seconds: of one change; solve_seconds: of one solve, which it saves. megabytes (2^20): what one
    change adds to the peak of resident memory of a process that has loaded the field.
    """
    solid, count, rows = bowl(6 if settings.quick else 16), 12 if settings.quick else 48, []
    for old, new, size in PAIRS:
        kept = replace(new, poisson=old.poisson)
        start, _ = _solved(solid, old, 1.0, count)
        found, seconds = timed(partial(change_material, start, old, kept, size=size))
        fresh, solve_seconds = _solved(solid, kept, size, count)
        ours, truth = (_by_pitch(each, fresh.bank.frequency) for each in (found, fresh))
        rows.append(
            {
                "frequency_error": float((found.bank.frequency / fresh.bank.frequency - 1).abs().max()),
                "damping_error": float((found.bank.damping / fresh.bank.damping - 1).abs().max()),
                "gain_error": float(((ours - truth).abs().amax(0) / truth.abs().amax(0)).max()),
                "seconds": seconds,
                "solve_seconds": solve_seconds,
            }
        )
        yield from records(rows[-1], object=f"{old.name} to {new.name}, {size:g} times as large")
    worst = {key: max(row[key] for row in rows) for key in rows[0] if key.endswith("error")}
    yield from records(means(rows) | worst, group="all")
    with tempfile.TemporaryDirectory(prefix="material-") as folder:
        path = Path(folder) / "bowl.safetensors"
        save(start, path)
        yield from records({"megabytes": apart(memory_of_change, path)})


def memory_of_change(path: Path) -> float:
    """Return what one change adds to the peak of this process's memory, megabytes of 2^20 bytes."""
    field = load(path)
    before = peak_gigabytes()
    change_material(field, CERAMIC, GLASS)
    return (peak_gigabytes() - before) * 1e9 / 2**20


def _solved(solid: Solid, material: Material, size: float, count: int) -> tuple[SoundField, float]:
    """Return the field of a fresh solve of the scaled solid, through gains at some corners, and its seconds."""
    scaled = Solid.build(size * solid.points, solid.cells)
    body, seconds = timed(lambda: elastic_modes(scaled, material, count=count))
    contacts = size * _contacts(solid)
    damping = rayleigh(body.frequency, material) / 2
    frequency = torch.sqrt(body.frequency.square() - (damping / (2 * math.pi)).square())
    gains, silence = _gain_model(contacts, _response(body, material, contacts)), Residual(torch.zeros(9))
    bank, phase = ModalBank(frequency, damping), torch.zeros_like(frequency)
    return SoundField(bank, gains, phase, silence, 192e3, 1000, Origin("bowl")), seconds


def _gain_model(contacts: Tensor, values: Tensor) -> MixtureGains:
    """Return gains of one kernel: linear in the values alike for all modes, so that the model adds no error."""
    sites = Sites(contacts, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(len(contacts), 3))
    smooth = Smooth(sites, float((contacts.amax(0) - contacts.amin(0)).norm())).take(torch.tensor([0]))
    series = series_of(values.to(torch.complex128))
    weights = torch.zeros(1, len(NOISE_SHARES), series.shape[1], dtype=torch.float64)
    weights[:, 0] = 1.0
    mixture = KernelMixture(smooth.kernels(), series, torch.zeros(series.shape[1], dtype=torch.float64), weights)
    return MixtureGains(contacts.float(), sites, (smooth,), mixture, directional=False)


def _response(body: ElasticModes, material: Material, contacts: Tensor) -> Tensor:
    """Return displacements of one point in each mode, by impacts of a newton-second at all, straight down."""
    down = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand(len(contacts), 3)
    shapes = body.gains(contacts, down)
    damping = rayleigh(body.frequency, material) / 2
    return shapes * shapes[_RESPONSE_NODE] / torch.sqrt((2 * math.pi * body.frequency).square() - damping.square())


def _contacts(solid: Solid) -> Tensor:
    corners = torch.unique(solid.boundary)
    return solid.points[corners[:: math.ceil(len(corners) / 24)]]


def _by_pitch(field: SoundField, frequency: Tensor) -> Tensor:
    """Return gains with modes of one frequency summed, which does not depend on the shapes that stand for them."""
    gains = field.gains(field.gain_field.points).double()
    apart = torch.diff(frequency) > 1e-5 * frequency[:-1]
    group = torch.cat([torch.zeros(1, dtype=torch.long), torch.cumsum(apart.long(), 0)])
    return torch.zeros(len(gains), int(group[-1]) + 1, dtype=gains.dtype).index_add(1, group, gains)


PARTS: dict[str, Measurement] = {"change-material": change}
