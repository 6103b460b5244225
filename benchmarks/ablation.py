"""Parts of the gain model: what each contributes, whether supports are found, and labels that are called wrong."""

import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from avmsf.evaluation.objects import roughened
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
from avmsf.simulate.recipe import ABLATED
from avmsf.simulate.shapes import make_shape
from benchmarks.report import Options, Report, Table, log
from benchmarks.splitcases import COUNTS, ROUGH, SplitCase, bodies_of, measured, simulated, split_case, splits_of
from tests.oracles.block import block
from tests.oracles.known_gains import known_gains

DEFAULT = "default"
_ALONE = tuple(f"{kind} alone" for kind in FAMILIES)
_LESS_KNOWN = ("positions alone", "positions and symmetry", "noisy mesh")
"""Variants that know less of the object: not settings among which one would choose."""


def ablation(options: Options) -> Report:
    """Errors without each part of the default model, or with what was dropped; one split of each object."""
    rows: list[list[str | float]] = []
    found: dict[str, dict[str, float]] = defaultdict(dict)
    cases = []
    for name, case in _ablated(options):
        cases.append(name)
        for variant, error in _variants(case, options):
            found[variant][name] = error
            log(f"{name}, {variant}: {error:.4f}")
    logs = {
        variant: {name: float(np.log(error / found[DEFAULT][name])) for name, error in errors.items()}
        for variant, errors in found.items()
    }
    ratios = {variant: float(np.exp(np.mean(list(each.values())))) for variant, each in logs.items()}
    for variant, errors in found.items():
        rows.append([variant, *(errors.get(name, "-") for name in cases), ratios[variant]])
    columns = ("model", *cases, "over the default, geometric mean")
    tables = (Table("held-out error without each part", columns, rows), _halves(logs, cases))
    figures = {f"gains.ablation.{variant.replace(' ', '_')}": ratio for variant, ratio in ratios.items()}
    return Report(tables=tables, figures=figures)


def _halves(logs: Mapping[str, Mapping[str, float]], cases: list[str]) -> Table:
    """Return the settings that are best on one half of the cases, and how they do on the other half.

    A case where a variant is no different, such as updating without a body, counts as the default.
    """
    rows: list[list[str | float]] = []
    settings = [each for each in logs if each not in (*_ALONE, *_LESS_KNOWN)]
    for number in range(2):
        chosen_on, judged_on = cases[number::2], cases[1 - number :: 2]

        def ratio(variant: str, names: list[str]) -> float:
            return float(np.exp(np.mean([logs[variant].get(name, 0.0) for name in names]))) if names else float("nan")

        best = min(settings, key=lambda variant: ratio(variant, chosen_on))
        rows.append([", ".join(chosen_on), best, ratio(best, chosen_on), ratio(best, judged_on)])
    columns = ("chosen on", "best setting", "over the default there", "on the other half")
    return Table("settings chosen on one half and judged on the other", columns, rows)


def _ablated(options: Options) -> Iterator[tuple[str, SplitCase]]:
    for name, count, start in (("aircraft_response", 15, 18), ("ruler10", 7, 0), ("tree43", 20, 18)):
        capture = measured(name)
        bodies = None if capture.surface is None else bodies_of(capture.surface, options)
        yield f"{name} {count}", split_case(*split(capture.impacts, count, start=start), capture, bodies)
    with tempfile.TemporaryDirectory() as cache:
        for name in options.objects or ABLATED[: 1 if options.quick_look else 3]:
            capture, _ = simulated(name, options, Path(cache))
            assert capture.surface is not None
            bodies = bodies_of(capture.surface, options)
            yield name, split_case(*split(capture.impacts, 0.2), capture, bodies)


def _variants(case: SplitCase, options: Options) -> Iterator[tuple[str, float]]:
    """Yield names of variants of the default model and their errors."""
    field = case.fit(MixtureEstimator(bodies=case.bodies), quick=False)
    yield DEFAULT, case.error(field)
    yield "not refined", case.error(case.fit(MixtureEstimator(bodies=case.bodies), quick=True))
    yield "stationary noise alone", case.error(replace(field, residual=Residual(field.residual.magnitude)))
    origin = replace(field.origin, config=replace(field.origin.config, residual_noise="gaussian"))
    yield "Gaussian noise", case.error(replace(field, origin=origin))
    assert isinstance(field.gain_field, MixtureGains)
    yield (
        "no spread within hypotheses",
        case.error(replace(field, gain_field=replace(field.gain_field, spread_share=0.0))),
    )
    if case.bodies is not None:
        yield "no updating", case.error(case.fit(MixtureEstimator(bodies=case.bodies, update=False), quick=False))
    for kind, label in zip(FAMILIES, _ALONE, strict=True):
        if (kind != Symmetric.kind or case.symmetries) and (kind != Elastic.kind or case.bodies):
            alone = MixtureEstimator((kind,), bodies=case.bodies, symmetries=case.symmetries)
            yield label, case.error(case.fit(alone, quick=True))
    yield "positions alone", case.error(case.fit(MixtureEstimator((Smooth.kind, ThinPlate.kind)), quick=False))
    yield "positions and symmetry", case.error(case.fit(MixtureEstimator(symmetries=case.symmetries), quick=False))
    if case.surface is not None:
        rough = bodies_of(roughened(case.surface, ROUGH, seed=0), options)
        yield "noisy mesh", case.error(case.fit(MixtureEstimator(bodies=rough), quick=False))


def outliers(options: Options) -> Report:
    """Exchanged labels that are named, and right ones that are, on the aircraft; right labels named on all captures."""
    captures = {name: measured(name) for name in COUNTS}
    bodies = {
        name: None if each.surface is None else bodies_of(each.surface, options) for name, each in captures.items()
    }
    draws = {"found": 0, "false": 0, "exchanged": 0, "clean_false": 0, "clean_fits": 0}
    for case in splits_of(captures["aircraft_response"], 15, bodies["aircraft_response"], options):
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
            log(f"exchanged {sorted(wrong)}, named {sorted(named)}")
    for name, counts in COUNTS.items():
        for count in counts[:1] if options.quick_look else counts:
            for case in splits_of(captures[name], count, bodies[name], options):
                draws["clean_false"] += len(_named(case))
                draws["clean_fits"] += 1
    rows: list[list[str | float]] = [["labels", *map(float, draws.values())]]
    figures = {f"outliers.{key}": float(value) for key, value in draws.items()}
    return Report(tables=(Table("labels called wrong", ("aircraft, 15 places", *draws), rows),), figures=figures)


def _named(case: SplitCase) -> set[str]:
    """Return the names of the training contacts that the fit reports as outliers."""
    return set(case.fit(MixtureEstimator(bodies=case.bodies), quick=True).origin.report["outliers"])


def supports(options: Options) -> Report:
    """Errors of the gains of objects that are free or held, by whether supports are tried, and what is found."""
    rows: list[list[str | float]] = []
    figures = {}
    mug = make_shape("mug", size=0.1, wall=0.003)
    objects = (
        ("plate", block((0.24, 0.16, 0.003), (16, 10, 1)), STEEL, Patch("a short side", (-1.0, 0.0, 0.0))),
        ("mug", mug.solid, CERAMIC, Patch("its base", (0.0, 0.0, -1.0))),
    )
    for kind, solid, material, patch in objects[: 1 if options.quick_look else None]:
        held = Support((patch,), 1e10)
        along = solid.points[solid.cells].mean(1)[:, 0] / solid.size
        uneven = 1 + 0.1 * torch.sin(2 * torch.pi * along).double()
        for support in (None, held):
            true = elastic_modes(solid, material, count=30, stiffness_factor=uneven, support=support)
            case, points, ways = known_gains(true)
            exact = true.gains(points, ways)
            row: list[str | float] = [f"{kind}, {'free' if support is None else support.name}"]
            for tried in ("free", "auto", "try", None):
                config = BodyConfig() if tried is None else BodyConfig(supports=tried)
                bodies = None if tried is None else candidate_bodies(solid.surface, config, log=log)
                model, _ = MixtureEstimator(bodies=bodies).solve(case)
                error = float((model.predict(points, ways).mean.real - exact).norm() / exact.norm())
                row += [error] if tried != "try" else [error, model.report["bodies"][0]["support"]]
                figures[f"gains.supports.{kind}.{'free' if support is None else 'held'}.{tried}"] = error
            rows.append(row)
            log(f"{row}")
    columns = ("object", "taken for free", "default", "supports tried", "found", "no body")
    return Report(tables=(Table("relative error of gains at 200 contacts, 12 known", columns, rows),), figures=figures)
