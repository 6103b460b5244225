"""How a fit makes the gain model: from recordings whose gains are known, and the bodies behind the surface."""

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from typing import Any

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf.capture.placement import expect_placed
from avmsf.capture.table import TABLE
from avmsf.errors import AvmsfError, FitError
from avmsf.features.feature_field import GEOMETRY, FeatureField
from avmsf.fem.candidate_bodies import CandidateBodies, CandidateBody, body_name
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.material import largest_factor
from avmsf.fem.supports import FREE, FREE_PRIOR
from avmsf.fem.thickness import search_thickness
from avmsf.fem.updating import update
from avmsf.field.config import AUTO, NETWORK, GainModelName
from avmsf.field.gains.attention import SHARED, Attention
from avmsf.field.gains.data import GainData, along_phase, gain_variance
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.fitting import MeasuredGains, WeighedFamily, fit_mixture, matched, total_evidence
from avmsf.field.gains.kernels import KernelFamily, Sites, Smooth, ThinPlate, Unstructured, Visual, sites_along
from avmsf.field.gains.labels import better_order, two_levels
from avmsf.field.gains.mixture import NOISE_SHARES
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.outliers import Fit, Judgment, assess_contacts, predicts_better
from avmsf.field.gains.refinement import RefinedGains
from avmsf.field.gains.symmetry import Symmetric
from avmsf.field.trainer import FittedGains, GainEstimator, Trainer
from avmsf.gaussians.points import farthest_points
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.symmetry.characters import Group, groups_of
from avmsf.symmetry.symmetries import Symmetries

POSITIONAL: dict[str, type[KernelFamily]] = {Smooth.kind: Smooth, ThinPlate.kind: ThinPlate}
"""Families that need nothing but the contacts, by name."""
FAMILIES = (*POSITIONAL, Symmetric.kind, Elastic.kind)
"""What the model is made of besides the unstructured family, which is always there."""
KNOWN = (*FAMILIES, Visual.kind)
"""All families. Looks must be asked for by name: with the built-in descriptors of four simulated objects they made the
errors between 0.4 % smaller and 1.7 % larger without a body, and changed nothing with one."""
_UPDATED = 64
"""Contacts that a body is updated from, or orders and levels are compared at, at most."""
_PREDICTS = 1.4
"""Nats per mode that a free body has to add, below which supports are tried. A plate clamped at an edge and taken for
free adds .5, a free one 2.3; mugs add 1.1 (held at the base) and 1.5, an aircraft .8 to 1.3."""
_SHOWN = 4
"""Changes that a message lists, at most."""
_PLACES = 500
"""Points of the surface where the contacts that contradict the others may have been."""


@dataclass(frozen=True, eq=False)
class MixtureEstimator(GainEstimator):
    """Fits a Gaussian process whose kernel families are weighed by evidence."""

    kinds: tuple[str, ...] = FAMILIES
    """Families to take; all of them unless one is studied by itself."""
    bodies: CandidateBodies | None = None
    """What may lie behind the surface; without it there is no elastic family."""
    missing: str = ""
    """Why there are no bodies, for the report."""
    symmetries: Symmetries | None = None
    """Of the object's geometry; without any there is no symmetry family.

    Nor is there where a body is usable, whose mode shapes have the symmetries already: with them the family made the
    error of one of 11 splits of captures 6 % larger, and none smaller than by 2 %.
    """
    update: bool = True
    """Whether the stiffness and density of the most probable body are updated."""

    def __post_init__(self) -> None:
        unknown = sorted(set(self.kinds) - set(KNOWN))
        if unknown:
            raise FitError.expected(f"some of {', '.join(KNOWN)}", unknown, got=", ".join(unknown), name="kinds")

    @property
    def name(self) -> str:
        """The family's name where there is one alone, else `auto`."""
        return AUTO if len(self.kinds) > 1 else self.kinds[0]

    def digest(self) -> str:
        """Return a digest of the families, the bodies and the symmetries."""
        bodies = "" if self.bodies is None else self.bodies.digest()
        symmetries = "" if self.symmetries is None else json.dumps(self.symmetries.to_dict())
        return hashlib.sha256(f"{' '.join(self.kinds)} {bodies} {symmetries} {self.update}".encode()).hexdigest()

    def start(self, data: GainData) -> tuple[RefinedGains, Int[Tensor, " contacts"]]:
        """Return the gain model, to be refined end to end, and its row of each contact. Raises as `solve`."""
        model, used = self.solve(data)
        rows = torch.full((len(data.train),), -1)
        rows[used] = torch.arange(len(used))
        return RefinedGains(model, data.modes.bank), rows

    def fit(self, data: GainData, trainer: Trainer) -> FittedGains:
        """Return the gain model, refined end to end, with its noise as measured by the refined modes."""
        refined, rows = self.start(data)
        used = torch.nonzero(rows >= 0).flatten()
        # A recording of another position than its label would pull the others' gains to its sound.
        run = trainer.run("fit", refined, data.take(used.tolist()), rows[used], warmup=0, steps=data.config.steps)
        order, rate = run.order, data.train.sample_rate
        measured = along_phase(*fit_gains(data.train.sounds, run.trained, sample_rate=rate), data.phase[order])
        reason = "as set" if data.config.damping == SHARED else "the only form of this gain model"
        damping = {"damping": SHARED, "validated": False, "damping_reason": reason}
        model = refined.finished(order, measured[used])
        return FittedGains(model, run, used.tolist(), model.report | damping)

    def solve(self, data: GainData) -> tuple[MixtureGains, Int[Tensor, " used"]]:
        """Return the gain model as it follows from the data's gains, and the rows of the contacts it is fitted to.

        Raises FitError where one family alone was asked for, elastic, symmetry or visual, and it cannot be had.

        The thickness of a wall that is not known is searched for. Of several coarse bodies the most probable one is
        computed with finer elements, and the model is fitted again, until the most probable one is fine. Where it
        predicts little it is tried whether the object was held. Contacts that the others contradict are left out where
        these are predicted better from each other without them. Last, the most probable body with its stiffness and
        density updated becomes one more hypothesis.
        """
        bodies, missing = self._usable_bodies(data)
        given, every = data.train.directions, torch.arange(len(data.train))
        directional = bool(bodies) or (given is not None and bool(given.any()))
        groups = () if bodies or self.symmetries is None else groups_of(self.symmetries)
        self._expect_inputs(data, groups)
        candidates, supported = self.bodies, False
        searched = candidates is not None and candidates.searches_thickness
        # Of a wall that is too thin, shapes of high modes may fit as well as those of the right one.
        largest = largest_factor(searched=True) if searched else math.inf
        fit = _Fit(data, self.kinds, _sites(data, bodies), directional, groups, largest)
        thickness = None
        if candidates is not None and searched and bodies:
            bodies, thickness = search_thickness(bodies, partial(fit.evidence, every), candidates.with_thickness)
        while True:
            families = fit.families(every, bodies)
            model = fit(every, families)
            weights = _body_weights(model, families, fit.measured)
            best = max(range(len(bodies)), key=weights.__getitem__, default=None)
            fine = None if best is None else self._refined(bodies[best])
            if best is not None and fine is not None:
                bodies[best] = fine
                continue
            judgment, used = _assessed(fit, model, None if best is None else bodies[best]), every
            if best is None or candidates is None or supported or not self._may_be_held(judgment):
                break
            rows, supported = _without(every, judgment), True
            held = _more_probable(fit, rows, candidates.supported(bodies[best]))
            if held is None:
                break
            # All modes have the support in common, so free bodies are no hypotheses any more.
            bodies = [held]
        if judgment.outliers:
            rows = _without(every, judgment)
            fewer_families = fit.families(rows, bodies)
            fewer = fit(rows, fewer_families)
            if predicts_better(fewer.leave_one_out(), model.leave_one_out()[rows], fit.at(rows)):
                model, families, used = fewer, fewer_families, rows
                weights = _body_weights(model, families, fit.measured)
        if bodies and self.update:
            updated = fit.updated(used, bodies[max(range(len(bodies)), key=weights.__getitem__)])
            if updated is not None:
                bodies.append(updated)
                families = fit.families(used, bodies)
                model = fit(used, families)
        weights = _body_weights(model, families, fit.measured)
        report = _report(bodies, families, weights, missing) | _outlier_report(judgment, data, used)
        report["thickness"] = None if thickness is None else asdict(thickness)
        report["advice"] = None if judgment.informative else _two_levels(fit) or _better_order(fit, bodies)
        return replace(model, report=report), used

    def _expect_inputs(self, data: GainData, groups: Sequence[Group]) -> None:
        """Raise FitError where one family alone was asked for and the symmetries or features that it needs are none."""
        if self.name == Symmetric.kind and not groups:
            raise FitError(
                "symmetry: expected symmetries of the object's shape, got none; take another gain model",
                name=Symmetric.kind,
            )
        if self.name == Visual.kind and data.features.encoder == GEOMETRY:
            raise FitError(
                "visual: expected visual features, got positions only; give --features, or take another gain model",
                name=Visual.kind,
                value=GEOMETRY,
            )

    def _usable_bodies(self, data: GainData) -> tuple[list[CandidateBody], dict[str, str]]:
        """Return the bodies that the contacts lie on, and why there are none."""
        missing = {body_name(each): reason for each, reason in self.bodies.refused.items()} if self.bodies else {}
        if Elastic.kind not in self.kinds:
            return [], {}
        if self.bodies is None:
            if self.name == Elastic.kind:
                raise FitError(
                    f"elastic: expected the object's shape, got none; {self.missing or 'give its mesh'}",
                    name=Elastic.kind,
                )
            return [], {Elastic.kind: self.missing} if self.missing else {}
        try:
            expect_placed(data.train.contacts, self.bodies.bodies[0].elastic.points, names=data.train.names)
        except FitError as error:
            if self.name == Elastic.kind:
                raise
            return [], {Elastic.kind: str(error)}
        return list(self.bodies.bodies), missing

    def _may_be_held(self, judgment: Judgment) -> bool:
        """Return whether supports are tried: where they are asked for, or the free body predicts little."""
        if self.bodies is None or self.bodies.supports == "free":
            return False
        found = judgment.credibility
        little = found is not None and found.with_body - found.without_body < _PREDICTS
        return self.bodies.supports == "try" or little

    def _refined(self, body: CandidateBody) -> CandidateBody | None:
        """Return a body with finer elements; None where it has been computed as finely as it can."""
        if self.bodies is None or body.fine:
            return None
        fine = self.bodies.refined(body)
        return None if fine is body else fine


def estimator_for(
    name: GainModelName,
    bodies: Callable[[], CandidateBodies],
    *,
    symmetries: Callable[[], Symmetries | None] = lambda: None,
    features: FeatureField | None = None,
    log: Callable[[str], None] | None = None,
) -> GainEstimator:
    """Return the estimator of this name; the network reads `features`, or the fit's own.

    `bodies` computes what may lie behind the object's surface. Where it raises an AvmsfError, `auto` has no elastic
    family, which `log` reports, and takes the `symmetries` of the object's shape. With `elastic` the error passes, and
    always that of a stated wall or number of degrees of freedom that cannot be (with the name `wall` or `dofs`).
    """
    if name == NETWORK:
        return Attention(features, NETWORK)
    if name != AUTO and name != Elastic.kind:
        return MixtureEstimator((name,), symmetries=symmetries() if name == Symmetric.kind else None)
    kinds = FAMILIES if name == AUTO else (name,)
    try:
        return MixtureEstimator(kinds, bodies())
    except AvmsfError as error:
        if name == Elastic.kind or error.name in ("wall", "dofs"):
            raise
        if log is not None:
            log(f"no elastic mode shapes: {error}")
        return MixtureEstimator(kinds, missing=str(error), symmetries=symmetries())


@dataclass(frozen=True, eq=False)
class _Fit:
    """Fits families to some of a case's contacts."""

    case: GainData
    kinds: tuple[str, ...]
    sites: Sites
    """All contacts."""
    directional: bool
    """Whether directions are known, or a body says which way its surface faces."""
    groups: tuple[Group, ...]
    """Symmetries of the object's shape."""
    largest_factor: float
    """The largest factor on the frequencies of bodies."""

    def elastic(self, sites: Sites, size: float, modes: ElasticModes) -> Elastic:
        """Return the family of a body."""
        return Elastic(sites, size, modes, largest_factor=self.largest_factor)

    @cached_property
    def measured(self) -> MeasuredGains:
        """The gains at all contacts, with the variance that background noise gives them."""
        bank = self.case.modes.bank
        return MeasuredGains(self.case.values, gain_variance(self.case), bank.frequency, bank.damping)

    def at(self, rows: Int[Tensor, " rows"]) -> MeasuredGains:
        """Return the gains at some contacts."""
        return replace(self.measured, values=self.measured.values[rows])

    @cached_property
    def compared(self) -> Int[Tensor, " rows"]:
        """Contacts at which orders and levels are compared, as recorded."""
        return farthest_points(self.sites.points, min(_UPDATED, len(self.sites))).sort().values

    def families(self, rows: Int[Tensor, " rows"], bodies: Sequence[CandidateBody]) -> list[KernelFamily]:
        """Return the families of these contacts; the elastic ones come last, in the order of the bodies."""
        sites, size = self.sites.take(rows), 2.0 * self.case.features.half_diagonal
        found: list[KernelFamily] = [Unstructured(sites, size)]
        found += [POSITIONAL[kind](sites, size) for kind in POSITIONAL if kind in self.kinds]
        if self.groups and Symmetric.kind in self.kinds:
            found.append(Symmetric(sites, size, self.groups, directional=self.directional))
        features = self.case.features
        if Visual.kind in self.kinds and features.encoder != GEOMETRY:
            found.append(Visual(sites, size, features.points, features.features))
        return [*found, *(self.elastic(sites, size, body.elastic) for body in bodies)]

    def __call__(
        self,
        rows: Int[Tensor, " rows"],
        families: Sequence[KernelFamily],
        noise_shares: tuple[float, ...] = NOISE_SHARES,
    ) -> MixtureGains:
        """Return the gain model of families of these contacts."""
        points = self.case.features.points
        return fit_mixture(families, self.at(rows), points, directional=self.directional, noise_shares=noise_shares)

    def evidence(self, rows: Int[Tensor, " rows"], bodies: Sequence[CandidateBody]) -> list[float]:
        """Return the log evidence of the gains of some contacts with each body by itself."""
        sites, size = self.sites.take(rows), 2.0 * self.case.features.half_diagonal
        measured = self.at(rows)
        others = [WeighedFamily.of(each, measured, NOISE_SHARES) for each in self.families(rows, [])]
        elastic = (WeighedFamily.of(self.elastic(sites, size, each.elastic), measured, NOISE_SHARES) for each in bodies)
        return [total_evidence([*others, each], measured) for each in elastic]

    def updated(self, rows: Int[Tensor, " rows"], body: CandidateBody) -> CandidateBody | None:
        """Return the body with its stiffness and density updated; None where that has no higher evidence."""
        if body.elastic.perturbations is None:
            return None
        # Spread contacts say enough of a few dozen coefficients, and the cost goes with the cube of their number.
        rows = rows[farthest_points(self.sites.points[rows], min(_UPDATED, len(rows))).sort().values]
        sites, size = self.sites.take(rows), 2.0 * self.case.features.half_diagonal
        measured = self.at(rows)
        others = [WeighedFamily.of(family, measured, NOISE_SHARES) for family in self.families(rows, [])]
        found = update(
            body.elastic, sites.points, sites.directions, measured.frequency, measured.values.real,
            measured.informative.chunk(2)[0],
            lambda modes: matched(others, self.elastic(sites, size, modes), measured),
        )  # fmt: skip
        return None if found is None else replace(body, elastic=found[0], updated=found[1])


def _sites(case: GainData, bodies: Sequence[CandidateBody]) -> Sites:
    """Return the training impacts; unknown directions go straight into the body.

    Without a body they are that of the nearest impact whose direction is known, or all alike where none is.
    """
    points, given = case.train.contacts.double(), case.train.directions

    def otherwise(unknown: Float64[Tensor, "unknown 3"]) -> Float64[Tensor, "unknown 3"]:
        if bodies:
            return -bodies[0].elastic.normals(unknown)
        known = torch.zeros(len(points), dtype=torch.bool) if given is None else given.any(1)
        if given is None or not bool(known.any()):
            return torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(len(unknown), 3)
        nearest = (unknown[:, None] - points[known]).square().sum(2).argmin(1)
        return torch.nn.functional.normalize(given[known][nearest].double(), dim=1)

    return sites_along(points, given, otherwise)


def _assessed(fit: _Fit, model: MixtureGains, body: CandidateBody | None) -> Judgment:
    """Return what contradicts the other contacts; the body is the most probable one."""
    points = model.points[farthest_points(model.points, min(_PLACES, len(model.points)))]

    def fitted(bodies: list[CandidateBody]) -> Fit:
        return lambda rows, noise_shares: fit(rows, fit.families(rows, bodies), noise_shares)

    elastic = None if body is None else fitted([body])
    return assess_contacts(fitted([]), elastic, fit.sites, model.sites(points), fit.measured)


def _two_levels(fit: _Fit) -> str | None:
    """Return from which recording on the level is another, and what to do; None where levels agree."""
    names, rows = fit.case.train.names, fit.compared
    sites, size = fit.sites.take(rows), 2.0 * fit.case.features.half_diagonal
    families = [Unstructured(sites, size), *(kind(sites, size) for kind in POSITIONAL.values())]
    found = two_levels(families, fit.at(rows))
    if found is None:
        return None
    first, level = found
    return (
        f"the recordings from {names[int(rows[first])]} on are {abs(level):.0f} dB "
        f"{'louder' if level > 0 else 'weaker'} than those before let expect, as if the gain, the microphone's place "
        "or the force's scale had changed: bring all to one level, or fit each group by itself"
    )


def _better_order(fit: _Fit, bodies: Sequence[CandidateBody]) -> str | None:
    """Return in which order the recordings agree with the contacts far better, and what to change; None for none."""
    names, rows = fit.case.train.names, fit.compared
    points, directional = fit.case.features.points, fit.directional
    found = better_order(names, fit.families(rows, bodies), rows, fit.measured, points, directional=directional)
    if found is None:
        return None
    best, order = found
    changed = [f"{names[new]} for {names[row]}" for row, new in enumerate(order.tolist()) if new != row]
    return (
        f"the recordings do not agree with the contacts, but would far better in another order, {best}: in "
        f"{TABLE} write {', '.join(changed[:_SHOWN])}{', ...' * (len(changed) > _SHOWN)} and fit again"
    )


def _without(rows: Int[Tensor, " rows"], judgment: Judgment) -> Int[Tensor, " kept"]:
    """Return the rows that are no outliers."""
    return torch.tensor([row for row in rows.tolist() if row not in {each.row for each in judgment.outliers}])


def _more_probable(fit: _Fit, rows: Int[Tensor, " rows"], bodies: Sequence[CandidateBody]) -> CandidateBody | None:
    """Return the most probable held body by the evidence of all modes, or None where the first, free, is the best.

    Where both bodies are far from the object, evidence between them means little: the held one also has to predict
    contacts left out surely better.
    """
    if len(bodies) < 2:
        return None
    free, *held = fit.evidence(rows, bodies)
    best = max(range(len(held)), key=held.__getitem__)
    if held[best] - free <= math.log(FREE_PRIOR / (1.0 - FREE_PRIOR) * len(held)):
        return None
    new, old = (fit(rows, fit.families(rows, [body])).leave_one_out() for body in (bodies[1 + best], bodies[0]))
    return bodies[1 + best] if predicts_better(new, old, fit.at(rows), candidates=len(held)) else None


def _body_weights(model: MixtureGains, families: Sequence[KernelFamily], measured: MeasuredGains) -> list[float]:
    """Return each body's posterior probability, mean over modes by their energy."""
    share = measured.energy / measured.energy.sum().clamp_min(torch.finfo(torch.float64).tiny)
    known = dict(zip(map(id, model.families), (model.shares() @ share).tolist(), strict=True))
    return [known.get(id(each), 0.0) for each in families if isinstance(each, Elastic)]


def _report(
    bodies: Sequence[CandidateBody], families: Sequence[KernelFamily], weights: Sequence[float], missing: dict[str, str]
) -> dict[str, Any]:
    elastic = [each for each in families if isinstance(each, Elastic)]
    found = [
        {
            "body": body.name,
            "wall_thickness": body.thickness,
            "support": FREE if body.support is None else body.support.name,
            "updating_nats": body.updated,
            "refined": body.fine,
            "weight": weight,
            "frequency_factor": family.factor,
        }
        for body, family, weight in zip(bodies, elastic, weights, strict=True)
    ]
    return {"bodies": sorted(found, key=lambda each: -each["weight"]), "unavailable": missing}


def _outlier_report(judgment: Judgment, case: GainData, used: Int[Tensor, " used"]) -> dict[str, Any]:
    names, contacts, credibility = case.train.names, case.train.contacts, judgment.credibility
    kept = set(used.tolist())
    with_body, given = credibility is not None and credibility.credible, case.train.directions
    return {
        "outliers": {
            names[each.row]: each.describe(
                names,
                contacts,
                directed=given is not None and bool(given[each.row].any()),
                with_body=with_body,
            )
            for each in judgment.outliers
        },
        "outlier_figures": {names[each.row]: each.figures() for each in judgment.outliers},
        "excluded": [name for row, name in enumerate(names) if row not in kept],
        "credibility": None if credibility is None else asdict(credibility) | {"credible": credibility.credible},
    }
