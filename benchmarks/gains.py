"""Gain models: held-out errors of the mixture, its families and simple methods, on measured and simulated objects."""

import tempfile
import time
import warnings
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from avmsf.bench.baselines import MeanWaveform
from avmsf.bench.evaluation import evaluate, score, split
from avmsf.bench.knowntruth import truth_at, truth_from_first_sample
from avmsf.capture import Capture, CaptureSettings, CaptureWarning, Impacts, Surface, read_capture
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.bodies import CandidateBodies
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.estimator import FAMILIES, KNOWN, POSITIONAL, MixtureEstimator
from avmsf.field.gains.symmetry import Symmetric
from avmsf.field.recipes import GainCase, along_phase
from avmsf.field.soundfield import SoundField
from avmsf.field.uncertainty import coverage, parts_of, std_of
from avmsf.modal.bank import ModalBank
from avmsf.modal.extraction.extract import Extraction, extract
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.residual import Residual
from avmsf.modal.synthesis import synthesise, synthesise_phased
from avmsf.pipeline.bodies import BodyConfig, candidate_bodies, roughened
from avmsf.scene.features import GEOMETRY, FeatureField
from avmsf.scene.symmetry import Symmetries
from avmsf.scene.symmetrycharacters import groups_of
from avmsf.scene.symmetrysearch import find_symmetries
from avmsf.simulate.elastic import ElasticModes
from avmsf.simulate.sim20 import ABLATED, SIM20, sim20_recipe
from avmsf.simulate.simulation import simulate_object
from avmsf.simulate.truth import Truth, read_truth
from benchmarks.material import example_capture, shared_data, surface_features
from benchmarks.report import Options, Report, Table, tell

STARTS = (0, 18, 37)
COUNTS = {"aircraft_response": (8, 15, 28), "ruler10": (5, 7), "tree43": (12, 20, 40)}
"""Training places of each measured capture."""
SIMPLE = {
    f"mean of {count}{' by direction' * by_direction}": partial(MeanWaveform, count=count, by_direction=by_direction)
    for by_direction in (False, True)
    for count in (1, 2, 3, 4)
}
"""Simple methods; the best of them in hindsight is what a field should never be much worse than."""
MIXTURE, UNREFINED = "mixture", "mixture, not refined"
CONVENTIONS = (
    "error: relative STFT error at held-out contacts, mean of farthest-point splits from contacts 0, 18 and 37, as far "
    "as there are so many; default settings. In brackets the worst split.",
    "families: the Gaussian process over the unstructured and this family alone, one end-to-end step; mixture, not "
    "refined: all families, one step; mixture: as `avmsf fit` has it.",
    "best simple: the mean waveform of 1 to 4 nearest recordings, by distance or by distance and direction, whichever "
    "is best on the held-out contacts of each split.",
)


@dataclass(frozen=True, eq=False)
class SplitCase:
    """One split of one object."""

    train: Impacts
    test: Impacts
    modes: Extraction
    features: FeatureField
    bodies: CandidateBodies | None
    surface: Surface | None

    def fit(self, estimator: MixtureEstimator, *, quick: bool) -> SoundField:
        """Return the field of an estimator, refined unless it should be quick."""
        steps = 1 if quick else FitConfig().steps
        config = FitConfig(warmup_steps=0, steps=steps)
        return fit(self.train, self.features, self.modes, config, gains=estimator)

    @cached_property
    def symmetries(self) -> Symmetries | None:
        """Of the mesh's points; None without a mesh, or where they have none."""
        if self.surface is None:
            return None
        found = find_symmetries(self.features.points, generator=torch.Generator().manual_seed(0))
        return found if groups_of(found) else None

    def coverage(self, field: SoundField) -> float:
        """Return the part of the held-out gains, by energy, in their intervals of 90 %."""
        parts = along_phase(*fit_gains(self.test.sounds, field.bank, sample_rate=field.sample_rate), field.phase)
        return coverage(field, self.test.contacts, parts, directions=self.test.directions).by_energy

    def error(self, field: SoundField) -> float:
        """Return the relative STFT error at the held-out contacts."""
        return evaluate(field, self.test).mean()["relative_stft"]


def measure(options: Options) -> Report:
    """Return the chosen parts."""
    report = Report(CONVENTIONS)
    for part in options.parts:
        report += PARTS[part](options)
    return report


def _captures(options: Options) -> Report:
    """Errors on measured captures, and how many measured gains lie in intervals of 90 %."""
    rows: list[list[str | float]] = []
    figures: dict[str, float] = {}
    ratios: list[float] = []
    bests: list[float] = []
    for name, counts in COUNTS.items():
        capture = _read(name)
        bodies = None if capture.surface is None else _bodies(capture, options)
        for count in counts[:1] if options.quick_look else counts:
            found: dict[str, list[float]] = defaultdict(list)
            for case in _splits(capture, count, bodies, options):
                single, inside = _errors(case, options)
                for method, error in single.items():
                    found[method].append(error)
                simple = min(single[method] for method in SIMPLE)
                found["best simple"].append(simple)
                found["coverage"].append(inside)
                ratios.append(single[MIXTURE] / simple)
                bests.append(single[MIXTURE] / min(single.values()))
            means = {method: float(np.mean(each)) for method, each in found.items()}
            tell(f"{name} {count}: {means}")
            shown = ("mean of 3", "best simple", *FAMILIES, UNREFINED, MIXTURE)
            cells = [f"{means[each]:.3f} ({max(found[each]):.3f})" if each in means else "-" for each in shown]
            rows.append([f"{name}, {count} places", *cells, f"{means['coverage']:.2f}"])
            key = "aircraft" if name == "aircraft_response" else name
            figures |= {f"gains.{key}.{count}.{method}": error for method, error in means.items()}
    figures |= {"gains.worst_ratio_to_simple": max(ratios), "gains.mean_ratio_to_best": float(np.mean(bests))}
    columns = ("capture", "mean of 3", "best simple", *FAMILIES, UNREFINED, MIXTURE, "in 90 % intervals")
    return Report(tables=(Table("held-out error of gain models on measured captures", columns, rows),), figures=figures)


def _errors(case: SplitCase, options: Options) -> tuple[dict[str, float], float]:
    """Return each method's error, and the part of held-out gains within the mixture's intervals of 90 %."""
    single = {
        method: evaluate(make(case.train), case.test).mean()["relative_stft"]
        for method, make in SIMPLE.items()
        if make.keywords["count"] <= len(case.train)
    }
    needed = {Elastic.kind: case.bodies, Symmetric.kind: case.symmetries}
    for kind in FAMILIES:
        if needed.get(kind, kind):
            alone = MixtureEstimator((kind,), case.bodies, symmetries=case.symmetries)
            single[kind] = case.error(case.fit(alone, quick=True))
    mixture = MixtureEstimator(bodies=case.bodies)
    single[UNREFINED] = case.error(case.fit(mixture, quick=True))
    field = case.fit(mixture, quick=options.quick_look)
    single[MIXTURE] = case.error(field)
    return single, case.coverage(field)


def _sim20(options: Options) -> Report:
    """Errors on the simulated objects with their meshes, 8 training contacts of 40."""
    found: dict[bool, list[list[str | float]]] = {False: [], True: []}
    with tempfile.TemporaryDirectory() as cache:
        for name in tuple(SIM20)[:2] if options.quick_look else tuple(SIM20):
            for tidy, rows in found.items():
                capture, truth = _simulated(name, options, Path(cache), tidy=tidy)
                # Both have the same mesh, so that the second finds its bodies.
                bodies = _bodies(capture, options, cache=Path(cache) / name)
                case = _case(*split(capture.impacts, fraction=0.2), capture, bodies)
                rows.append([name, *_simulated_row(case, truth, options)])
                tell(f"{'tidy' if tidy else 'untidy'} {rows[-1]}")
    report = Report()
    for tidy, rows in found.items():
        values = np.array([row[1:] for row in rows])
        means = [*values[:, :_ERRORS].mean(0), *np.exp(np.log(values[:, _ERRORS:-1]).mean(0)), values[:, -1].mean()]
        rows.append(["mean; of ratios the geometric mean", *map(float, means)])
        title = f"simulated objects, 8 contacts, exact meshes{', recordings that need no alignment' * tidy}"
        keys = {f"gains.sim20{'_tidy' * tidy}_{key}": float(value) for key, value in zip(_KEYS, means, strict=True)}
        report += Report(tables=(Table(title, ("object", *_KEYS), rows),), figures=keys)
    return report


_KEYS = ("error", "averaging", "modal", "l1", "l1_log", "envelope", "coverage")
_ERRORS = 3
"""So many of the keys are errors; the others are ratios to averaging, and the last is the coverage."""


def _simulated_row(case: SplitCase, truth: Truth, options: Options) -> list[float]:
    """Return the figures of one simulated object."""
    field = case.fit(MixtureEstimator(bodies=case.bodies), quick=options.quick_look)
    scores, averaged = evaluate(field, case.test).mean(), evaluate(MeanWaveform(case.train), case.test).mean()
    row = [scores["relative_stft"], averaged["relative_stft"], _modal_error(field, case.test, truth)]
    row += [scores[metric] / averaged[metric] for metric in ("l1", "l1_log", "envelope")]
    return [*row, case.coverage(field)]


def _ablation(options: Options) -> Report:
    """Errors without each part of the default model, or with what was dropped; one split of each object."""
    cases = dict(_ablated(options))
    rows: list[list[str | float]] = []
    figures = {}
    found: dict[str, dict[str, float]] = defaultdict(dict)
    for name, case in cases.items():
        for variant, error in _variants(case, options):
            found[variant][name] = error
            tell(f"{name}, {variant}: {error:.4f}")
    for variant, errors in found.items():
        ratio = float(np.exp(np.mean([np.log(error / found["default"][name]) for name, error in errors.items()])))
        rows.append([variant, *(errors.get(name, "-") for name in cases), ratio])
        figures[f"gains.ablation.{variant.replace(' ', '_')}"] = ratio
    columns = ("model", *cases, "over the default, geometric mean")
    return Report(tables=(Table("held-out error without each part", columns, rows),), figures=figures)


def _ablated(options: Options) -> Iterator[tuple[str, SplitCase]]:
    for name, count, start in (("aircraft_response", 15, 18), ("ruler10", 7, 0), ("tree43", 20, 18)):
        capture = _read(name)
        bodies = None if capture.surface is None else _bodies(capture, options)
        yield f"{name} {count}", _case(*split(capture.impacts, count=count, start=start), capture, bodies)
    with tempfile.TemporaryDirectory() as cache:
        for name in ABLATED[: 1 if options.quick_look else 3]:
            capture, _ = _simulated(name, options, Path(cache))
            bodies = _bodies(capture, options)
            yield name, _case(*split(capture.impacts, fraction=0.2), capture, bodies)


def _variants(case: SplitCase, options: Options) -> Iterator[tuple[str, float]]:
    """Yield names of variants of the default model and their errors."""
    field = case.fit(MixtureEstimator(bodies=case.bodies), quick=False)
    yield "default", case.error(field)
    yield "not refined", case.error(case.fit(MixtureEstimator(bodies=case.bodies), quick=True))
    yield "stationary noise alone", case.error(replace(field, residual=Residual(field.residual.magnitude)))
    origin = replace(field.origin, config=replace(field.origin.config, residual_noise="gaussian"))
    yield "Gaussian noise", case.error(replace(field, origin=origin))
    yield "magnitudes lifted half way", case.error(_Lifted(field))  # type: ignore[arg-type]
    yield "positions alone", case.error(case.fit(MixtureEstimator(tuple(POSITIONAL)), quick=False))
    yield "positions and symmetry", case.error(case.fit(MixtureEstimator(symmetries=case.symmetries), quick=False))
    if case.bodies is not None:
        nominal = [
            replace(body, elastic=replace(body.elastic, perturbations=None)) for body in case.bodies.bodies.bodies
        ]
        bodies = CandidateBodies(replace(case.bodies.bodies, bodies=tuple(nominal)), case.bodies.refine)
        yield "no updating", case.error(case.fit(MixtureEstimator(bodies=bodies), quick=False))
    if case.surface is not None:
        rough = _bodies_of(roughened(case.surface, _ROUGH, seed=0), options)
        yield "noisy mesh", case.error(case.fit(MixtureEstimator(bodies=rough), quick=False))
    if case.features.encoder != GEOMETRY:
        yield "visual features", case.error(case.fit(MixtureEstimator(KNOWN, bodies=case.bodies), quick=False))


def _outliers(options: Options) -> Report:
    """Exchanged labels that are named, and right ones that are, on the aircraft; right labels named on all captures."""
    captures = {name: _read(name) for name in COUNTS}
    bodies = {name: None if each.surface is None else _bodies(each, options) for name, each in captures.items()}
    draws = {"found": 0, "false": 0, "exchanged": 0, "clean_false": 0, "clean_fits": 0}
    for case in _splits(captures["aircraft_response"], 15, bodies["aircraft_response"], options):
        for seed in range(1 if options.quick_look else 9):
            # Three contacts get the labels of one another, in a circle.
            drawn = np.random.default_rng(seed).choice(len(case.train), 3, replace=False)
            order = torch.arange(len(case.train))
            order[torch.from_numpy(drawn)] = torch.from_numpy(np.roll(drawn, 1))
            directions = None if case.train.directions is None else case.train.directions[order]
            train = replace(case.train, contacts=case.train.contacts[order], directions=directions)
            named, wrong = _named(replace(case, train=train)), {case.train.names[row] for row in drawn.tolist()}
            draws["found"] += len(named & wrong)
            draws["false"] += len(named - wrong)
            draws["exchanged"] += 3
            tell(f"exchanged {sorted(wrong)}, named {sorted(named)}")
    for name, counts in COUNTS.items():
        for count in counts[:1] if options.quick_look else counts:
            for case in _splits(captures[name], count, bodies[name], options):
                draws["clean_false"] += len(_named(case))
                draws["clean_fits"] += 1
    rows: list[list[str | float]] = [["labels", *map(float, draws.values())]]
    figures = {f"outliers.{key}": float(value) for key, value in draws.items()}
    return Report(tables=(Table("labels called wrong", ("aircraft, 15 places", *draws), rows),), figures=figures)


def _named(case: SplitCase) -> set[str]:
    """Return the names of the training contacts that the fit reports as outliers."""
    return set(case.fit(MixtureEstimator(bodies=case.bodies), quick=True).origin.report["outliers"])


def _speed(options: Options) -> Report:
    """Seconds of the fit of the built-in example with its elastic modes at hand, and of the gains of a large case."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CaptureWarning)
        capture = example_capture()
    bodies = _bodies(capture, options)
    train, test = split(capture.impacts, count=12)
    case = _case(train, test, capture, bodies)
    start = time.perf_counter()
    case.fit(MixtureEstimator(bodies=bodies), quick=options.quick_look)
    seconds = {"example_fit_s": time.perf_counter() - start}
    contacts, modes = (20, 12) if options.quick_look else (200, 128)
    large = _large_case(bodies.bodies.bodies[0].elastic, contacts, modes)
    start = time.perf_counter()
    MixtureEstimator(bodies=bodies).fit(large)
    seconds["large_fit_s"] = time.perf_counter() - start
    rows: list[list[str | float]] = [
        [f"fit of the example, 12 contacts, {len(case.modes.bank)} modes", seconds["example_fit_s"]]
    ]
    rows.append([f"gain model of {contacts} contacts and {modes} modes, bodies and outliers", seconds["large_fit_s"]])
    figures = {f"gains.{key}": value for key, value in seconds.items()}
    return Report(tables=(Table("seconds with elastic modes at hand", ("work", "seconds"), rows),), figures=figures)


def _large_case(elastic: ElasticModes, contacts: int, modes: int) -> GainCase:
    """Return gains of random mixtures of neighboring mode shapes at random places of a body, with 3 % of noise."""
    generator = torch.Generator().manual_seed(0)
    points = elastic.nodes[torch.randperm(len(elastic.nodes), generator=generator)[:contacts]]
    directions = -elastic.normals(points)
    frequency = torch.linspace(float(elastic.frequency[0]), float(elastic.frequency[-1]), modes, dtype=torch.float64)
    near = torch.exp(-0.5 * ((elastic.frequency[:, None] - frequency) / (0.05 * frequency)).square())
    mixed = near * torch.randn(near.shape, generator=generator, dtype=torch.float64)
    gains = elastic.gains(points, directions) @ mixed
    gains = gains + 0.03 * gains.std(0) * torch.randn(gains.shape, generator=generator, dtype=torch.float64)
    impacts = Impacts(
        contacts=points.float(), sounds=torch.zeros(contacts, 4410), sample_rate=44100.0,
        names=tuple(f"{row:03d}" for row in range(contacts)), directions=directions.float(),
    )  # fmt: skip
    bank = ModalBank(frequency, torch.full_like(frequency, 20.0))
    quadrature = 0.02 * gains * torch.randn(gains.shape, generator=generator, dtype=torch.float64)
    found = Extraction(bank, gains, Residual(torch.zeros(1025)), quadrature)
    phase = torch.zeros(modes, dtype=torch.float64)
    return GainCase(impacts, FeatureField.from_points(elastic.nodes.float()), found, phase, gains, FitConfig())


@dataclass(frozen=True, eq=False)
class _Lifted:
    """A field whose gains have magnitudes half way, in decibels, to the posterior median of the magnitude."""

    field: SoundField

    @property
    def sample_rate(self) -> float:
        return self.field.sample_rate

    def render(self, contacts: Tensor, *, directions: Tensor | None = None, samples: int | None = None) -> Tensor:
        """Return the sounds."""
        mean, deviation = parts_of(self.field, contacts, directions), std_of(self.field, contacts, directions)
        drawn = torch.randn(200, *mean.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        median = (mean + deviation * drawn).norm(dim=3).median(dim=0).values
        lifted = mean * (median / mean.norm(dim=2).clamp_min(1e-30)).sqrt()[..., None]
        bank, length = self.field.bank, samples or self.field.samples
        made = synthesise_phased(
            lifted[..., 0].float(), bank.frequency, bank.damping, self.field.phase, samples=length,
            sample_rate=self.sample_rate, quadrature=lifted[..., 1].float(),
        )  # fmt: skip
        silent = replace(self.field, residual=Residual(torch.zeros_like(self.field.residual.magnitude)))
        noise = self.field.render(contacts, directions=directions, samples=length)
        return made + noise - silent.render(contacts, directions=directions, samples=length)


def _modal_error(field: SoundField, test: Impacts, truth: Truth) -> float:
    """Return the error of the field's modes against the true ones, both without noise."""
    true = truth_from_first_sample(truth_at(truth, test.names), test)
    clean = synthesise(
        true.gains.float(),
        true.frequency,
        true.damping,
        samples=test.sounds.shape[1],
        sample_rate=test.sample_rate,
        quadrature=true.quadrature.float(),
    )
    silent = replace(field, residual=Residual(torch.zeros_like(field.residual.magnitude)))
    made = silent.render(test.contacts, directions=test.directions, samples=test.sounds.shape[1])
    return score(made, replace(test, sounds=clean)).mean()["relative_stft"]


def _splits(capture: Capture, count: int, bodies: CandidateBodies | None, options: Options) -> Iterator[SplitCase]:
    """Yield the splits of a capture."""
    starts = [start for start in STARTS if start < len(capture.impacts)]
    for start in starts[:1] if options.quick_look else starts:
        yield _case(*split(capture.impacts, count=count, start=start), capture, bodies)


def _case(train: Impacts, test: Impacts, capture: Capture, bodies: CandidateBodies | None) -> SplitCase:
    modes = extract(train)
    contacts = capture.impacts.contacts
    features = FeatureField.from_contacts(contacts) if capture.surface is None else surface_features(capture)
    return SplitCase(modes.aligned(train), modes.aligned(test), modes, features, bodies, capture.surface)


def _bodies(capture: Capture, options: Options, *, cache: Path | None = None) -> CandidateBodies:
    assert capture.surface is not None
    return _bodies_of(capture.surface, options, cache)


def _bodies_of(surface: Surface, options: Options, cache: Path | None = None) -> CandidateBodies:
    config = BodyConfig(shapes=12, freedoms=3000) if options.quick_look else BodyConfig()
    return candidate_bodies(surface, config, cache=cache, tell=tell)


def _read(name: str) -> Capture:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CaptureWarning)
        return read_capture(shared_data() / name, CaptureSettings())


def _simulated(name: str, options: Options, cache: Path, *, tidy: bool = False) -> tuple[Capture, Truth]:
    """Return an object of the set and its truth, from the folder or simulated now.

    A tidy one has recordings that start with their impacts and impacts of nearly one speed: without what the set got
    when recordings began to be aligned.
    """
    if options.sim20 is not None and not tidy:
        return read_capture(options.sim20 / name), read_truth(options.sim20 / name)
    recipe = sim20_recipe(name)
    if tidy:
        recipe = replace(recipe, imperfections=replace(recipe.imperfections, **_TIDY))
    made = simulate_object(recipe, name=name, cache=cache)
    return made.capture, made.truth


_ROUGH = 0.003
"""Standard deviation of a noisy mesh's vertices along each axis, over the object's size."""
_TIDY = {"speed": 0.15, "contact_time": 0.0, "pretrigger": 0.0, "jitter": 0.0, "propagation": 0.0}


PARTS = {"captures": _captures, "sim20": _sim20, "ablation": _ablation, "outliers": _outliers, "speed": _speed}
