"""Parts of the gain model: what each contributes, whether supports are found, and labels that are called wrong."""

from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from avmsf.evaluation.splits import split
from avmsf.fem.elastic_modes import elastic_modes
from avmsf.fem.material import CERAMIC, STEEL
from avmsf.fem.supports import Patch, Support
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.estimator import FAMILIES, MixtureEstimator
from avmsf.field.gains.kernels import Smooth, ThinPlate
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.symmetry import Symmetric
from avmsf.modal.residual_noise import Residual
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import BodyConfig
from avmsf.simulate.recipe import ABLATED, SIM20
from avmsf.simulate.shapes import make_shape
from benchmarks import objects
from benchmarks.records import Record, Settings, records
from tests.oracles.block import block
from tests.oracles.known_gains import known_gains

DEFAULT = "default"


def ablation(settings: Settings) -> Iterator[Record]:
    """Errors without each part of the default model, or with what was dropped; one split of each object.

    over the default: geometric mean of the ratios.
    """
    found: dict[str, dict[str, float]] = defaultdict(dict)
    for name, case in _ablated(settings):
        for variant, error in _variants(case, settings):
            found[variant][name] = error
            yield from records({"error": error}, group=variant, object=name)
    for variant, errors in found.items():
        ratios = [error / found[DEFAULT][name] for name, error in errors.items()]
        yield from records({"over the default": float(np.exp(np.log(ratios).mean()))}, group=variant)


def _ablated(settings: Settings) -> Iterator[tuple[str, objects.SplitCase]]:
    for name, count, start in (("aircraft_response", 15, 18), ("ruler10", 7, 0), ("tree43", 20, 18)):
        capture = objects.measured(name)
        bodies = None if capture.surface is None else objects.bodies_of(capture.surface, settings)
        yield f"{name} {count}", objects.SplitCase.of(*split(capture.impacts, count, start=start), capture, bodies)
    for name in settings.objects or settings.some(ABLATED[:3]):
        capture, _ = objects.simulated(name, settings)
        bodies = objects.bodies_of(objects.surface_of(capture), settings)
        yield name, objects.SplitCase.of(*split(capture.impacts, 0.2), capture, bodies)


def _variants(case: objects.SplitCase, settings: Settings) -> Iterator[tuple[str, float]]:
    """Yield names of variants of the default model and their errors."""
    default = MixtureEstimator(bodies=case.bodies)
    field = case.fit(default)
    yield DEFAULT, case.error(field)
    yield "not refined", case.error(case.fit(default, quick=True))
    yield "stationary noise alone", case.error(replace(field, residual=Residual(field.residual.magnitude)))
    origin = replace(field.origin, config=replace(field.origin.config, residual_noise="gaussian"))
    yield "Gaussian noise", case.error(replace(field, origin=origin))
    assert isinstance(field.gain_field, MixtureGains)
    less = replace(field, gain_field=replace(field.gain_field, spread_share=0.0))
    yield "no spread within hypotheses", case.error(less)
    if case.bodies is not None:
        yield "no updating", case.error(case.fit(MixtureEstimator(bodies=case.bodies, update=False)))
    for kind in FAMILIES:
        if (kind != Symmetric.kind or case.symmetries) and (kind != Elastic.kind or case.bodies):
            alone = MixtureEstimator((kind,), bodies=case.bodies, symmetries=case.symmetries)
            yield f"{kind} alone", case.error(case.fit(alone, quick=True))
    yield "positions alone", case.error(case.fit(MixtureEstimator((Smooth.kind, ThinPlate.kind))))
    yield "positions and symmetry", case.error(case.fit(MixtureEstimator(symmetries=case.symmetries)))
    if case.surface is not None:
        rough = objects.bodies_of(objects.roughened(case.surface, objects.ROUGH, seed=0), settings)
        yield "noisy mesh", case.error(case.fit(MixtureEstimator(bodies=rough)))


def outliers(settings: Settings) -> Iterator[Record]:
    """Exchanged labels that are named, and right ones that are, on the aircraft; right labels named on all captures.

    In each draw three of 15 contacts get the labels of one another, in a circle.
    """
    captures = {name: objects.measured(name) for name in objects.COUNTS}
    bodies = {
        name: None if each.surface is None else objects.bodies_of(each.surface, settings)
        for name, each in captures.items()
    }
    draws = Counter[str]()
    for case in objects.splits_of(captures["aircraft_response"], 15, bodies["aircraft_response"], settings):
        for seed in settings.some(range(9)):
            drawn = np.random.default_rng(seed).choice(len(case.train), 3, replace=False)
            order = torch.arange(len(case.train))
            order[torch.from_numpy(drawn)] = torch.from_numpy(np.roll(drawn, 1))
            directions = None if case.train.directions is None else case.train.directions[order]
            train = replace(case.train, contacts=case.train.contacts[order], directions=directions)
            named, wrong = _named(replace(case, train=train)), {case.train.names[row] for row in drawn.tolist()}
            draws.update(found=len(named & wrong), false=len(named - wrong), exchanged=3)
    for name, counts in objects.COUNTS.items():
        for count in settings.some(counts):
            for case in objects.splits_of(captures[name], count, bodies[name], settings):
                draws.update(clean_false=len(_named(case)), clean_fits=1)
    yield from records(draws)


def _named(case: objects.SplitCase) -> set[str]:
    """Return the names of the training contacts that the fit reports as outliers."""
    return set(case.fit(MixtureEstimator(bodies=case.bodies), quick=True).origin.report["outliers"])


def supports(settings: Settings) -> Iterator[Record]:
    """Relative error of the gains of objects that are free or held, at 200 contacts, 12 known.

    held: rigidly, softly: by springs of 200 kN/m. free: taken for free; auto: the default; try: supports tried, and
    what is found; no body: by positions alone.
    """
    base = Patch("its base", (0.0, 0.0, -1.0))
    cases = (
        ("plate", block((0.24, 0.16, 0.003), (16, 10, 1)), STEEL, Patch("a short side", (-1.0, 0.0, 0.0))),
        ("mug", make_shape("mug", size=0.1, wall=0.003).solid, CERAMIC, base),
        ("steel mug", make_shape("mug", size=0.08, wall=0.0015).solid, STEEL, base),
    )
    for kind, solid, material, patch in settings.some(cases):
        along = solid.points[solid.cells].mean(1)[:, 0] / solid.size
        uneven = 1 + 0.1 * torch.sin(2 * torch.pi * along).double()
        for state, stiffness in (("free", 0.0), ("held softly", 2e5), ("held", 1e10)):
            support = Support((patch,), stiffness) if stiffness else None
            true = elastic_modes(solid, material, count=30, stiffness_factor=uneven, support=support)
            case, points, ways = known_gains(true)
            exact = true.gains(points, ways)
            errors, found = {}, ""
            for tried in ("free", "auto", "try", None):
                bodies = None if tried is None else candidate_bodies(solid.surface, BodyConfig(supports=tried))
                model, _ = MixtureEstimator(bodies=bodies).solve(case)
                error = (model.predict(points, ways).mean.real - exact).norm() / exact.norm()
                errors[tried or "no body"] = float(error)
                found = model.report["bodies"][0]["support"] if tried == "try" else found
            yield from records(errors, group=f"{kind}, {state}", note=found)


def free(settings: Settings) -> Iterator[Record]:
    """Whether objects that are free are taken for held where supports are tried, before refinement.

    The ruler and the aircraft, first splits, and simulated objects with 8 contacts. held: 1 if it is; error: relative
    STFT at held-out contacts.
    """
    counts = {name: objects.COUNTS[name] for name in ("ruler10", "aircraft_response")}
    counts |= dict.fromkeys(settings.objects or SIM20, (8,))
    mistakes = []
    for name in settings.some(tuple(counts)):
        capture = objects.measured(name) if name in objects.COUNTS else objects.simulated(name, settings)[0]
        bodies = objects.bodies_of(objects.surface_of(capture), settings, supports="try")
        for count in counts[name]:
            case = objects.SplitCase.of(*split(capture.impacts, count), capture, bodies)
            field = case.fit(MixtureEstimator(bodies=bodies), quick=True)
            found = field.origin.report["bodies"][0]["support"]
            mistakes.append(float(found != "free"))
            row = {"held": mistakes[-1], "error": case.error(field)}
            yield from records(row, group=str(count), object=name, note=found)
    yield from records({"held": sum(mistakes)}, note=f"of {len(mistakes)}")
