"""DiffSound and SonicGauss: errors on simulated objects; what DiffSound recovers, how the small SonicGauss learns."""

import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch

from avmsf.baselines.diffsound.locator import DiffSoundLocator
from avmsf.baselines.diffsound.material_fit import MODES, DampingCurve, DiffSoundConfig, clip_spectra, fit_material
from avmsf.baselines.diffsound.renderer import fit_diffsound
from avmsf.capture import Capture, read_capture
from avmsf.capture.impacts import Impacts
from avmsf.cli.heartbeat import beating
from avmsf.datasets import CaptureCollection
from avmsf.errors import EvaluationError
from avmsf.evaluation.localization import judge_locating
from avmsf.evaluation.methods import method_named
from avmsf.evaluation.object_bodies import ObjectBodies
from avmsf.evaluation.object_features import ObjectLooks
from avmsf.evaluation.plan import Evaluation
from avmsf.evaluation.protocols import PROTOCOLS
from avmsf.evaluation.results import ObjectRecord, ResultsFolder
from avmsf.evaluation.run import run_object
from avmsf.evaluation.sound_metrics import Judging
from avmsf.evaluation.splits import split
from avmsf.evaluation.summary import figures_of, labels_of, means
from avmsf.fem.body_family import BodyFamily, body_family
from avmsf.fem.material import Material, material_named
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.localization.locator import Locator
from avmsf.mesh import Surface
from avmsf.modal.extraction.extract import extract_modes
from avmsf.modal.modes import ModalBank
from avmsf.modal.synthesis import synthesize
from avmsf.simulate.sim20 import sim20_recipe
from avmsf.simulate.simulation import simulate_object
from avmsf.simulate.simulation_folder import write_simulation
from benchmarks.costs import method_costs
from benchmarks.material import surface_features
from benchmarks.paperrun import paper_runs
from benchmarks.report import Options, Report, Table, log
from benchmarks.sonicgauss import small_method, train_small
from benchmarks.surface import views_and_gaussians

OWN = (("blob-polycarbonate", 1.0), ("dish-ceramic", 1.13))
"""Objects, and their walls' thickness over one of those that are computed beforehand."""
STIFFER, POISSON = 1.37, 0.27
"""The true material: so much stiffer than the table's, and its Poisson's ratio."""
FEW = ("mug-ceramic", "blob-polycarbonate", "bowl-glass")
"""Objects of curves over impacts, and of locating; all are filled: a handle, a lump, and a foot that prisms miss."""
MORE = (*FEW, "spoon-wood", "bracket-steel", "dish-ceramic")
METHODS = ("knn3", "diffsound", "diffsound-weighted")
LOCATING = ("random", "nearest", "cosine", "diffsound")
RATE, SECONDS = 48_000.0, 0.5
CONVENTIONS = (
    "diffsound: two clips of the body, 16 modes of equal amplitude, Rayleigh damping; stiffness E / rho 37 % above "
    "the table's, which the fit does not know, nor the thickness. Seconds of CPU: bodies, then fit.",
    "sonicgauss-training: makes the weights of sonicgauss-small in the file --weights; sim20 and shots take the method "
    "where that file is there. Seconds of CPU: making the objects, then training.",
    "sim20, shots: `avmsf evaluate`, farthest (8 of 40 impacts) and shots, exact meshes; means over objects of L1 at "
    "full scale and of the relative STFT error. Stiffness errors are relative to the material's table.",
    "locating: 8 of 40 impacts, held-out impacts, candidates of diffsound are the mesh's vertices; cosine is of a "
    "field without bodies. Distance over the diagonal of the box around the object.",
)
_Records = list[ObjectRecord]


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
            with beating(part):
                report += PARTS[part](objects)
    return report


class _Objects:
    """Simulated objects, read or made, and their bodies, each computed once."""

    def __init__(self, options: Options, folder: Path) -> None:
        self.options, self.folder, self._given, self._clouds = options, folder, options.sim20, options.clouds
        self.quick, self.most = options.quick_look, 1 if options.quick_look else None
        self.weights = folder / "sonicgauss-small.safetensors" if options.weights is None else options.weights
        self.few, self.more = options.objects or FEW, options.objects or MORE
        self.family = cache(self._family)

    def root(self, names: Sequence[str]) -> Path:
        """Return the folder that holds these objects."""
        if self._given is not None:
            return self._given
        for name in names:
            if not (self.folder / "captures" / name).exists():
                write_simulation(simulate_object(sim20_recipe(name), name=name), self.folder / "captures" / name)
        return self.folder / "captures"

    def capture(self, name: str) -> Capture:
        return read_capture(self.root([name]) / name)

    def surface(self, name: str) -> Surface:
        surface = self.capture(name).surface
        assert surface is not None
        return surface

    def _family(self, name: str) -> BodyFamily:
        return body_family(self.surface(name), count=MODES, log=log)

    def cloud(self, identifier: str, views: int | None = None) -> GaussianCloud:
        clouds = self.folder / "clouds" if self._clouds is None else self._clouds
        clouds.mkdir(parents=True, exist_ok=True)
        return views_and_gaussians(self.root([identifier]) / identifier, clouds, quick=self.quick)[1]

    def training(self) -> Report:
        cache = None if self._clouds is None else self._clouds / "sonicgauss"
        return train_small(self.weights, cache=cache, quick=self.quick)

    def records(self, protocol: str, names: Sequence[str]) -> _Records:
        """Return what `avmsf evaluate` finds of objects."""
        dataset = CaptureCollection(self.root(names))
        features = self.folder / "features"
        evaluation = Evaluation(
            dataset, "sim-20", PROTOCOLS[protocol], (*map(method_named, METHODS), *small_method(self.weights)),
            ObjectLooks(dataset, features), ObjectBodies(dataset, features), judging=Judging(cdpam=False),
            clouds=self.cloud,
        )  # fmt: skip
        results = ResultsFolder(self.folder / protocol)
        evaluation.begin(results)
        for name in names:
            run_object(evaluation, name, results, log=log)
        return [record for record in map(results.read, names) if record is not None]


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


def _sim20(objects: _Objects) -> Report:
    names = objects.more[: objects.most]
    records = objects.records("farthest", names)
    methods = _methods(records)
    rows: list[list[str | float]] = []
    for record in records:
        chosen = next((each for each in record.outcomes if each.method == "diffsound"), None)
        table = material_named(sim20_recipe(record.identifier).material)
        stiffness = math.nan if chosen is None or chosen.failure else chosen.report["stiffness"]
        errors: list[str | float] = [_error(record, method) for method in methods]
        rows.append([record.identifier, stiffness / (table.young / table.density) - 1.0, *errors])
    columns = ("object", "stiffness error", *map(_short, methods))
    tables = (Table("sim20: relative STFT error of each object, 8 impacts", columns, rows), *_errors("sim20", records))
    off = [abs(float(row[1])) for row in rows if math.isfinite(float(row[1]))]
    figures = {"sim20.diffsound.stiffness_error": sum(off) / len(off) if off else math.nan}
    return Report(tables=tables, figures=figures | _figures("sim20", records))


def _shots(objects: _Objects) -> Report:
    records = objects.records("shots", objects.few[: objects.most])
    return Report(tables=_errors("shots", records), figures=_figures("shots", records))


def _methods(records: _Records) -> tuple[str, ...]:
    """Return the methods of records in their order."""
    return tuple(dict.fromkeys(each.method for record in records for each in record.outcomes))


def _short(method: str) -> str:
    """Return a method's name without the path of its weights."""
    return method.partition(":")[0]


def _error(record: ObjectRecord, method: str) -> float:
    found = means(figures_of([record], labels_of([record])[0]))
    return found[method]["relative_stft"].mean if method in found else math.nan


def _figures(part: str, records: _Records) -> dict[str, float]:
    """Return the two errors, means over objects, by training impacts and method."""
    figures = {}
    for label in labels_of(records):
        found = means(figures_of(records, label))
        key = f"{part}.{label.split()[0]}" if part == "shots" else part
        for method in _methods(records):
            if method in found:
                figures[f"{key}.{_short(method)}"] = found[method]["l1"].mean
                figures[f"{key}.{_short(method)}.relative_stft"] = found[method]["relative_stft"].mean
    return figures


def _errors(part: str, records: _Records) -> tuple[Table, ...]:
    figures = _figures(part, records)
    rows: list[list[str | float]] = [
        [key, value, figures[f"{key}.relative_stft"]] for key, value in figures.items() if not key.endswith("stft")
    ]
    return (Table(f"{part}: means over objects", ("method", "L1", "relative STFT error"), rows),)


def _costs(objects: _Objects) -> Report:
    name = objects.few[0]
    weights = (f"sonicgauss-small:{objects.weights.resolve()}",) if objects.weights.is_file() else ()
    methods = METHODS[:1] if objects.quick else (*METHODS, *weights, "field", "field-auto")
    return method_costs(objects.root([name]).resolve(), name, methods, objects.folder / "costs")


def _locating(objects: _Objects) -> Report:
    rows: list[list[str | float]] = []
    for name in FEW[: objects.most]:
        capture = objects.capture(name)
        assert capture.surface is not None
        train, test = split(capture.impacts, 0.2)
        modes = extract_modes(train)
        config = DiffSoundConfig(sim20_recipe(name).material)
        renderer = fit_diffsound(train, objects.family(name), modes, config, weighted=False)
        field = fit(train, surface_features(capture), modes, FitConfig(steps=0), gains=MixtureEstimator())
        scores = judge_locating(
            Locator.of(field), train, test, name=name, methods=LOCATING,
            diffsound=DiffSoundLocator.of(renderer, capture.surface.vertices),
        )  # fmt: skip
        rows.append([name, *(scores.figures(method)["rmed"] for method in LOCATING)])
        log(f"locating {rows[-1]}")
    figures = {
        f"locating.{method}.rmed": sum(float(row[place]) for row in rows) / len(rows)
        for place, method in enumerate(LOCATING, 1)
    }
    return Report(tables=(Table("locating: relative mean distance", ("object", *LOCATING), rows),), figures=figures)


PARTS: dict[str, Callable[[_Objects], Report]] = {
    "sonicgauss-training": _Objects.training,
    "diffsound": _diffsound,
    "sim20": _sim20,
    "shots": _shots,
    "locating": _locating,
    "costs": _costs,
    "paper": lambda objects: paper_runs(objects.options, objects.folder),
}
