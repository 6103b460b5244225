"""What DiffSound recovers, how the small SonicGauss learns, and what methods cost."""

import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch

from avmsf.baselines.diffsound.body_family import BodyFamily, body_family
from avmsf.baselines.diffsound.material_fit import MODES, DampingCurve, clip_spectra, fit_material
from avmsf.capture import Capture, read_capture
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.fem.material import Material, material_named
from avmsf.mesh import Surface
from avmsf.modal.modes import ModalBank
from avmsf.modal.synthesis import synthesize
from avmsf.simulate.recipe import named_recipe
from avmsf.simulate.simulation import simulate_object
from avmsf.simulate.simulation_folder import write_simulation
from benchmarks.costs import method_costs
from benchmarks.paperrun import paper_runs
from benchmarks.report import Options, Report, Table, log
from benchmarks.sonicgauss import train_small

OWN = (("blob-polycarbonate", 1.0), ("dish-ceramic", 1.13))
"""Objects, and their walls' thickness over one of those that are computed beforehand."""
STIFFER, POISSON = 1.37, 0.27
"""The true material: so much stiffer than the table's, and its Poisson's ratio."""
COSTS_OBJECT = "mug-ceramic"
METHODS = ("knn3", "diffsound", "diffsound-weighted")
RATE, SECONDS = 48_000.0, 0.5
CONVENTIONS = (
    "diffsound: two clips of the body, 16 modes of equal amplitude, Rayleigh damping; stiffness E / rho 37 % above "
    "the table's, which the fit does not know, nor the thickness. Seconds of CPU: bodies, then fit.",
    "sonicgauss-training: makes the weights of sonicgauss-small in the file --weights. Seconds of CPU: making "
    "the objects, then training.",
)


def measure(options: Options) -> Report:
    """Return the chosen parts."""
    report = Report(CONVENTIONS)
    making = "sonicgauss-training" in options.parts
    if making and options.weights is None:
        raise EvaluationError("sonicgauss-training: expected --weights FILE to write, got none", name="weights")
    if options.weights is not None and not making and not options.weights.is_file():
        raise EvaluationError(
            f"{options.weights}: expected weights, found no file; add the part sonicgauss-training",
            file=options.weights,
            name="weights",
        )
    with tempfile.TemporaryDirectory() as folder:
        objects = _Objects(options, Path(folder))
        for part in options.parts:
            log(f"baselines.{part}")
            report += PARTS[part](objects)
    return report


class _Objects:
    """Simulated objects, read or made, and their bodies, each computed once."""

    def __init__(self, options: Options, folder: Path) -> None:
        self.options, self.folder, self._given = options, folder, options.sim20
        self.quick, self.most = options.quick_look, 1 if options.quick_look else None
        self.weights = folder / "sonicgauss-small.safetensors" if options.weights is None else options.weights
        self.family = cache(self._family)

    def root(self, names: Sequence[str]) -> Path:
        """Return the folder that holds these objects."""
        if self._given is not None:
            return self._given
        for name in names:
            if not (self.folder / "captures" / name).exists():
                write_simulation(simulate_object(named_recipe(name), name=name), self.folder / "captures" / name)
        return self.folder / "captures"

    def capture(self, name: str) -> Capture:
        return read_capture(self.root([name]) / name)

    def surface(self, name: str) -> Surface:
        surface = self.capture(name).surface
        assert surface is not None
        return surface

    def _family(self, name: str) -> BodyFamily:
        return body_family(self.surface(name), count=MODES, log=log)

    def training(self) -> Report:
        return train_small(self.weights, quick=self.quick)


@dataclass(frozen=True)
class _Recovered:
    """Errors of one fit, relative, and its time."""

    stiffness: float
    thickness: float
    poisson: float
    bodies_seconds: float
    fit_seconds: float


def _diffsound(objects: _Objects) -> Report:
    rows: list[list[str | float]] = []
    found = []
    for name, part in OWN[: objects.most]:
        each = _recovered(name, part, objects)
        log(f"{name}: {each}")
        found.append(each)
        rows.append([name, each.stiffness, each.thickness, each.poisson, each.bodies_seconds, each.fit_seconds])
    thick = [abs(each.thickness) for each in found if math.isfinite(each.thickness)]
    figures = {
        "diffsound.stiffness_error": max(abs(each.stiffness) for each in found),
        "diffsound.thickness_error": max(thick, default=math.nan),
        "diffsound.seconds": sum(each.bodies_seconds + each.fit_seconds for each in found) / len(found),
    }
    columns = ("object", "stiffness error", "thickness error", "Poisson's ratio - true", "bodies, s", "fit, s")
    return Report(tables=(Table("DiffSound on bodies that sound as it assumes", columns, rows),), figures=figures)


def _recovered(name: str, part: float, objects: _Objects) -> _Recovered:
    table = material_named(name.split("-")[1])
    material = replace(table, young=STIFFER * table.young, poisson=POISSON)
    begun = time.process_time()
    family = objects.family(name)
    bodies = time.process_time() - begun
    thickness = family.thickness[1] * part if family.walled else None
    clips, curve = _clips(family, thickness, material)
    begun = time.process_time()
    found = fit_material(clip_spectra(clips), curve, family)
    seconds = time.process_time() - begun
    return _Recovered(
        found.stiffness / (material.young / material.density) - 1.0,
        math.nan if thickness is None or found.thickness is None else found.thickness / thickness - 1.0,
        found.poisson - material.poisson,
        bodies,
        seconds,
    )


def _clips(family: BodyFamily, thickness: float | None, material: Material) -> tuple[Impacts, DampingCurve]:
    """Return two recordings of a body, all of whose modes sound alike, and its dampings."""
    frequency = family.at(thickness).modes(material).frequency
    frequency = frequency[frequency < 0.4 * RATE]
    damping = 0.5 * (material.alpha + material.beta * (2.0 * math.pi * frequency).square())
    sounds = synthesize(
        torch.ones(2, len(frequency)), frequency, damping, samples=round(SECONDS * RATE), sample_rate=RATE
    )
    return Impacts(torch.zeros(2, 3), sounds, RATE, ("1.wav", "2.wav")), DampingCurve.of(ModalBank(frequency, damping))


def _costs(objects: _Objects) -> Report:
    name = (objects.options.objects or (COSTS_OBJECT,))[0]
    weights = (f"sonicgauss-small:{objects.weights.resolve()}",) if objects.weights.is_file() else ()
    methods = METHODS[:1] if objects.quick else (*METHODS, *weights, "field", "field-auto")
    return method_costs(objects.root([name]).resolve(), name, methods, objects.folder / "costs")


PARTS: dict[str, Callable[[_Objects], Report]] = {
    "sonicgauss-training": _Objects.training,
    "diffsound": _diffsound,
    "costs": _costs,
    "paper": lambda objects: paper_runs(objects.options, objects.folder),
}
