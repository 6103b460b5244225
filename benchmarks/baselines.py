"""What DiffSound recovers, and how the small SonicGauss learns. What methods cost: `avmsf evaluate` stores times."""

import math
from collections.abc import Iterator
from dataclasses import replace

import torch

from avmsf.baselines.diffsound.body_family import BodyFamily, body_family
from avmsf.baselines.diffsound.material_fit import MODES, DampingCurve, clip_spectra, fit_material
from avmsf.capture.impacts import Impacts
from avmsf.fem.material import Material, material_named
from avmsf.modal.modes import ModalBank, synthesize
from benchmarks.objects import simulated, surface_of
from benchmarks.processes import processor_seconds
from benchmarks.records import Measurement, Record, Settings, means, records
from benchmarks.sonicgauss import training

OWN = (("blob-polycarbonate", 1.0), ("dish-ceramic", 1.13))
"""Objects, and their walls' thickness over one of those that are computed beforehand."""
STIFFER, POISSON = 1.37, 0.27
"""The true material: so much stiffer than the table's, and its Poisson's ratio."""
RATE, SECONDS = 48_000.0, 0.5


def _diffsound(settings: Settings) -> Iterator[Record]:
    """Relative errors of stiffness E / rho and thickness, error of Poisson's ratio, all signed, and processor time.

    Two clips of the body, 16 modes of equal amplitude, Rayleigh damping; a material 37 % stiffer than the table's,
    which the fit does not know, nor the thickness. bodies_seconds: of the bodies computed beforehand.
    """
    rows = []
    for name, part in settings.some(OWN):
        table = material_named(name.split("-")[1])
        material = replace(table, young=STIFFER * table.young, poisson=POISSON)
        begun = processor_seconds()
        family = body_family(surface_of(simulated(name, settings)[0]), count=MODES)
        bodies = processor_seconds() - begun
        thickness = family.thickness[1] * part if family.walled else None
        clips, curve = _clips(family, thickness, material)
        begun = processor_seconds()
        found = fit_material(clip_spectra(clips), curve, family)
        rows.append(
            {
                "stiffness_error": found.stiffness / (material.young / material.density) - 1.0,
                "thickness_error": (found.thickness or math.nan) / (thickness or math.nan) - 1.0,
                "poisson_error": found.poisson - material.poisson,
                "bodies_seconds": bodies,
                "seconds": processor_seconds() - begun,
            }
        )
        yield from records(rows[-1], object=name)
    yield from records(means([{key: abs(value) for key, value in row.items()} for row in rows]), group="mean")


def _clips(family: BodyFamily, thickness: float | None, material: Material) -> tuple[Impacts, DampingCurve]:
    """Return two recordings of a body, all of whose modes sound alike, and its dampings."""
    frequency = family.at(thickness).modes(material).frequency
    frequency = frequency[frequency < 0.4 * RATE]
    damping = 0.5 * (material.alpha + material.beta * (2.0 * math.pi * frequency).square())
    gains = torch.ones(2, len(frequency))
    sounds = synthesize(gains, frequency, damping, samples=round(SECONDS * RATE), sample_rate=RATE)
    return Impacts(torch.zeros(2, 3), sounds, RATE, ("1.wav", "2.wav")), DampingCurve.of(ModalBank(frequency, damping))


PARTS: dict[str, Measurement] = {"sonicgauss-training": training, "diffsound": _diffsound}
