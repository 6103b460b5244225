"""Few impacts on simulated objects that are not of sim-20: what the prior of profiles and the rendered gains add."""

from collections.abc import Iterator
from dataclasses import fields, replace
from unittest.mock import patch

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf.bench.cases import Shots
from avmsf.field.gains import elastic, mixture
from avmsf.field.gains.elastic import PERTURBATIONS, PROFILE_PRIOR, REMAINDER_PRIOR, REMAINDERS, WIDTHS, Elastic
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.gains.model import MixtureGains
from avmsf.field.soundfield import SoundField
from avmsf.simulate.recipe import ObjectRecipe
from avmsf.simulate.simulation import simulate_object
from benchmarks.report import Options, Report, Table, tell
from benchmarks.splitcases import SplitCase, bodies_of, split_case

OBJECTS = (
    ("skillet", "steel"),
    ("plate", "glass"),
    ("spoon", "iron"),
    ("bowl", "ceramic"),
    ("jug", "plastic"),
    ("dish", "wood"),
    ("mug", "glass"),
)
"""Kinds and materials; the seeds are 101 and so on."""
COUNTS = (8, 4, 2, 1)
VARIANTS = ("default", "mean gains rendered", "profiles equally probable", "scale unknown")

_UNKNOWN = 1e-9
"""Shape of a prior of the scale that says nothing."""


def few(options: Options) -> Report:
    """Errors by number of impacts: with the mean gains rendered, without the profiles' prior, without the scale's."""
    rows: list[list[str | float]] = []
    found: dict[tuple[str, int], list[float]] = {}
    shares = []
    for seed, (kind, material) in enumerate(OBJECTS, start=101):
        name = f"{kind}-{material}"
        if options.objects and name not in options.objects:
            continue
        for count, case in _cases(ObjectRecipe(kind=kind, material=material, seed=seed), name, options):
            errors, typical = _errors(case, options)
            rows.append([f"{name}, {count}", *errors])
            tell(f"{rows[-1]}")
            for variant, error in zip(VARIANTS, errors, strict=True):
                found.setdefault((variant, count), []).append(error)
            if count == COUNTS[0]:
                shares.append(typical)
        if options.quick_look:
            break
    means = {key: sum(errors) / len(errors) for key, errors in found.items()}
    rows += [[f"mean, {count}", *(means[variant, count] for variant in VARIANTS)] for count in COUNTS]
    tables = (Table("relative STFT error by impacts", ("object, impacts", *VARIANTS), rows), _shares(shares))
    figures = {f"gains.few.{count}.{variant.replace(' ', '_')}": mean for (variant, count), mean in means.items()}
    return Report(tables=tables, figures=figures)


def _cases(recipe: ObjectRecipe, name: str, options: Options) -> Iterator[tuple[int, SplitCase]]:
    capture = simulate_object(recipe, name=name).capture
    assert capture.surface is not None
    bodies = bodies_of(capture.surface, options)
    # From 16 impacts on, so that the test contacts are those of `avmsf evaluate shots`.
    for case in Shots().cases(capture.impacts):
        if len(case.train) in COUNTS:
            train, test = capture.impacts.take(case.train), capture.impacts.take(case.test)
            yield len(case.train), split_case(train, test, capture, bodies)


def _errors(case: SplitCase, options: Options) -> tuple[list[float], Float64[Tensor, "profiles remainders"]]:
    """Return the errors of all variants, and the posterior of profiles where all are equally probable beforehand."""
    estimator = MixtureEstimator(bodies=case.bodies)
    default = case.fit(estimator, quick=options.quick_look)
    with patch.object(elastic, "EQUAL_PRIOR", 1.0):
        equal = case.fit(estimator, quick=options.quick_look)
    with patch.object(mixture, "SCALE_SHAPE", _UNKNOWN):
        unscaled = case.fit(estimator, quick=options.quick_look)
    return [case.error(each) for each in (default, with_means(default), equal, unscaled)], _posterior(equal)


def _posterior(field: SoundField) -> Float64[Tensor, "profiles remainders"]:
    """Return the mean over modes of the probability of each profile with each remainder, within the elastic family."""
    gains = field.gain_field
    assert isinstance(gains, MixtureGains)
    total, row = torch.zeros((len(PERTURBATIONS) + len(WIDTHS)) * len(REMAINDERS), dtype=torch.float64), 0
    for family, kept in zip(gains.families, gains.kept, strict=True):
        if isinstance(family, Elastic):
            weights = gains.mixture.weights[row : row + len(kept)].sum((1, 2))
            total.index_add_(0, family.categories()[kept], weights)
        row += len(kept)
    return (total / total.sum()).reshape(-1, len(REMAINDERS))


def _shares(found: list[Float64[Tensor, "profiles remainders"]]) -> Table:
    mean = torch.stack(found).mean(0)
    names = [f"perturbation {each:g}" for each in PERTURBATIONS] + [f"width {each:g}" for each in WIDTHS]
    rows: list[list[str | float]] = [
        list(each) for each in zip(names, mean.sum(1).tolist(), PROFILE_PRIOR, strict=True)
    ]
    remainders = zip((f"remainder {each:g}" for each in REMAINDERS), mean.sum(0).tolist(), REMAINDER_PRIOR, strict=True)
    rows += [list(each) for each in remainders]
    columns = ("profile or remainder", "posterior, all equally probable", "typical share in the code")
    return Table(f"posterior of profiles with {COUNTS[0]} impacts, mean over objects", columns, rows)


class _MeanGains(MixtureGains):
    """Gains whose mean is rendered."""

    point_estimate = MixtureGains.at


def with_means(field: SoundField) -> SoundField:
    """Return the field that renders the mean gains of its Gaussian process."""
    gains = field.gain_field
    return replace(field, gain_field=_MeanGains(**{each.name: getattr(gains, each.name) for each in fields(gains)}))  # type: ignore[arg-type]
