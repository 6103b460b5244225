"""DiffSound: what it recovers of bodies that sound as it assumes, its errors by training impacts, and where it locates."""

import math
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from avmsf.bench.judging import Judging
from avmsf.bench.methods import method_named
from avmsf.bench.plan import Evaluation
from avmsf.bench.protocols import PROTOCOLS
from avmsf.bench.results import ResultsFolder
from avmsf.bench.run import run_object
from avmsf.bench.summary import figures_of, labels_of, means
from avmsf.capture import Surface, read_capture
from avmsf.capture.datasets import CaptureCollection
from avmsf.capture.impacts import Impacts
from avmsf.evaluation.material_fit import MODES, DampingCurve, clip_spectra, fit_material
from avmsf.fem.family import BodyFamily, body_family
from avmsf.modal.bank import ModalBank
from avmsf.modal.synthesis import synthesise
from avmsf.pipeline.objectbodies import ObjectBodies
from avmsf.pipeline.objectlooks import ObjectLooks
from avmsf.simulate.material import Material, material_named
from avmsf.simulate.sim20 import sim20_recipe
from avmsf.simulate.simulation import simulate_object
from avmsf.simulate.simulationfolder import write_simulation
from benchmarks.report import Options, Report, Table, tell

OWN = (("mug-ceramic", 1.0), ("blob-polycarbonate", 1.0), ("pot-steel", 1.13), ("bracket-steel", 1.13))
"""Objects, and their walls' thickness over one of those that are computed beforehand."""
STIFFER, POISSON = 1.37, 0.27
"""The true material: so much stiffer than the table's, and its Poisson's ratio."""
SHOTS = ("mug-ceramic", "pot-steel", "bracket-steel", "bowl-glass")
METHODS = ("knn3", "diffsound", "diffsound-weighted", "field-auto")
RATE, SECONDS = 48_000.0, 0.5
CONVENTIONS = (
    "diffsound: two clips of the body, 16 modes of equal amplitude, Rayleigh damping; stiffness E / rho 37 % above "
    "the table's, which the fit does not know, nor the thickness. Seconds of CPU: bodies, then fit.",
    "shots: `avmsf evaluate shots`, means over objects of L1 at full scale and of the relative STFT error.",
)


def measure(options: Options) -> Report:
    """Return the chosen parts."""
    report = Report(CONVENTIONS)
    for part in options.parts:
        report += PARTS[part](options)
    return report


@dataclass(frozen=True)
class _Recovered:
    """Errors of one fit, relative, and its time."""

    stiffness: float
    thickness: float
    poisson: float
    bodies_seconds: float
    fit_seconds: float


def _diffsound(options: Options) -> Report:
    rows: list[list[str | float]] = []
    found = []
    for name, part in OWN[: 1 if options.quick_look else None]:
        each = _recovered(name, part, options)
        tell(f"{name}: {each}")
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


def _recovered(name: str, part: float, options: Options) -> _Recovered:
    surface, table = _surface(name, options), material_named(name.split("-")[1])
    material = replace(table, young=STIFFER * table.young, poisson=POISSON)
    begun = time.process_time()
    family = body_family(surface, count=MODES, tell=tell)
    bodies = time.process_time() - begun
    thickness = family.thickness[1] * part if family.walled else None
    clips, curve = _clips(family, thickness, material)
    begun = time.process_time()
    fit = fit_material(clip_spectra(clips), curve, family)
    seconds = time.process_time() - begun
    return _Recovered(
        fit.stiffness / (material.young / material.density) - 1.0,
        math.nan if thickness is None or fit.thickness is None else fit.thickness / thickness - 1.0,
        fit.poisson - material.poisson,
        bodies,
        seconds,
    )


def _clips(family: BodyFamily, thickness: float | None, material: Material) -> tuple[Impacts, DampingCurve]:
    """Return two recordings of a body, all of whose modes sound alike, and its dampings."""
    frequency = family.at(thickness).modes(material).frequency
    frequency = frequency[frequency < 0.4 * RATE]
    damping = 0.5 * (material.alpha + material.beta * (2.0 * math.pi * frequency).square())
    sounds = synthesise(
        torch.ones(2, len(frequency)), frequency, damping, samples=round(SECONDS * RATE), sample_rate=RATE
    )
    return Impacts(torch.zeros(2, 3), sounds, RATE, ("1.wav", "2.wav")), DampingCurve.of(ModalBank(frequency, damping))


def _surface(name: str, options: Options) -> Surface:
    if options.sim20 is not None:
        surface = read_capture(options.sim20 / name).surface
    else:
        surface = simulate_object(replace(sim20_recipe(name), views=0, contacts=2), name=name).capture.surface
    assert surface is not None
    return surface


def _shots(options: Options) -> Report:
    with tempfile.TemporaryDirectory() as folder:
        dataset = CaptureCollection(_captures(options, Path(folder) / "captures"))
        names = SHOTS[: 1 if options.quick_look else None]
        bodies = ObjectBodies(dataset, Path(folder) / "features")
        methods = tuple(method_named(each) for each in METHODS[: 3 if options.quick_look else None])
        evaluation = Evaluation(
            dataset, "sim-20", PROTOCOLS["shots"], methods, ObjectLooks(dataset, Path(folder) / "features"), bodies,
            judging=Judging(cdpam=False), families=bodies.family,
        )  # fmt: skip
        results = ResultsFolder(Path(folder) / "results")
        evaluation.begin(results)
        for name in names:
            run_object(evaluation, name, results, tell=tell)
        records = [record for record in map(results.read, names) if record is not None]
    rows: list[list[str | float]] = []
    figures = {}
    for label in labels_of(records):
        found = means(figures_of(records, label))
        count = label.split()[0]
        for method in METHODS:
            if method not in found:
                continue
            rows.append([f"{label}, {method}", found[method]["l1"].mean, found[method]["relative_stft"].mean])
            figures[f"shots.{count}.{method}"] = found[method]["l1"].mean
            figures[f"shots.{count}.{method}.relative_stft"] = found[method]["relative_stft"].mean
    return Report(tables=(Table("errors by training impacts", ("method", "L1", "error"), rows),), figures=figures)


def _captures(options: Options, folder: Path) -> Path:
    """Return the folder of the simulated objects, made now where none is given."""
    if options.sim20 is not None:
        return options.sim20
    for name in SHOTS[: 1 if options.quick_look else None]:
        write_simulation(simulate_object(sim20_recipe(name), name=name), folder / name)
    return folder


PARTS = {"diffsound": _diffsound, "shots": _shots}
