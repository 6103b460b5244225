"""How a fit makes the gain model: from recordings whose gains are known, and the bodies behind the surface."""

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial

import torch
from jaxtyping import Complex128, Float, Int
from torch import Tensor, nn

from avmsf.capture.placement import expect_on_body
from avmsf.errors import AvmsfError, FitError
from avmsf.features.feature_field import GEOMETRY
from avmsf.fem.candidate_bodies import PRESENT_UNIT, CandidateBodies, CandidateBody
from avmsf.fem.thickness import search_thickness
from avmsf.field.config import AUTO, NETWORK, GainModelName
from avmsf.field.gains.attention import SHARED, Attention
from avmsf.field.gains.data import GainData, along_phase
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.kernels import POSITIONAL, Unstructured, Visual
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import Gains, complex_of
from avmsf.field.gains.outliers import Credibility, others, predicts_better
from avmsf.field.gains.regression import Regression, Solution, sites_of
from avmsf.field.gains.symmetry import Symmetric
from avmsf.field.training import FittedGains, GainEstimator, TrainableGains, Trainer
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.modes import ModalBank, turned_like
from avmsf.symmetry.characters import Group, groups_of
from avmsf.symmetry.symmetries import Symmetries

FAMILIES = (*(kind for kind in POSITIONAL if kind != Unstructured.kind), Symmetric.kind, Elastic.kind)
"""What the model is made of besides the unstructured family, which is always there."""
KNOWN = (*FAMILIES, Visual.kind)
"""All families; that of visual features must be asked for by name (docs/decisions/gain-model.md)."""
_PREDICTS = 1.4
"""Nats per mode that a free body has to add, below which supports are tried. A plate clamped at an edge and taken for
free adds .5, a free one 2.3; mugs add 1.1 (held at the base) and 1.5, an aircraft .8 to 1.3."""
_PACE = 3
"""Steps of a network's training that one step here stands for, in all rates: gains start where they were solved. See
docs/decisions/network-training.md."""
_STEP = 600.0
"""Standard errors that a parameter of one stands for: a learning rate made for networks then moves gains in time."""
_STRENGTH = 0.1
"""Spectral loss that gains are worth which are off by one standard error each: about what it measures of them."""


class RefinedGains(TrainableGains):
    """A gain model whose measured gains may move, each as far as its standard error allows.

    With the hypotheses' weights kept, the mean gains are linear in the measured ones. So the gain model is the prior of
    the refinement too: gains move where the spectra of all recordings ask for it and the kernels allow it.
    """

    def __init__(self, model: MixtureGains, bank: ModalBank) -> None:
        """Start from the model of the modes of `bank`, whose energies say how much a gain matters."""
        super().__init__()
        self.model = model
        # All tensors are [series, contacts, 1], series as in the mixture.
        smoother, values = model.mixture.smoother(), model.mixture.values.T[..., None]
        self.smoother, self.start = nn.Buffer(smoother.float()), nn.Buffer((smoother @ values).float())
        self.noise = nn.Buffer(model.mixture.standard_error().float()[:, None, None])
        energy = values.reshape(2, len(bank), -1).square().sum((0, 2)) / bank.damping
        self.share = nn.Buffer((energy / energy.sum().clamp_min(torch.finfo(torch.float64).tiny)).float())
        self.shift = nn.Parameter(torch.zeros_like(self.start))

    def read(self, rows: Int[Tensor, " contacts"]) -> Gains:
        """Return the gains at some of the model's contacts."""
        smoothed = self.start + self.smoother @ (self.noise * _STEP * self.shift)
        return Gains(complex_of(smoothed[:, rows, 0].T.contiguous()))

    def penalty(self) -> Float[Tensor, ""]:
        """Return the squared shifts over the squared standard errors, each mode by its part of the energy."""
        squares = (_STEP * self.shift).square().reshape(2, len(self.share), -1).mean((0, 2))
        return 0.5 * _STRENGTH * (squares * self.share).sum()

    def finished(
        self, order: Int[Tensor, " modes"], measured: Complex128[Tensor, "contacts modes"] | None = None
    ) -> MixtureGains:
        """Return the model of the gains as they stand, with its modes in the given order.

        It judges itself by the `measured` gains that these modes, in order, have in the recordings. Frequencies that
        moved end to end have turned their modes, which says nothing of the gains.
        """
        moved = (self.noise * _STEP * self.shift).detach().double()[..., 0].T
        model = self.model.with_values(self.model.values + complex_of(moved)).take(order)
        return model if measured is None else replace(model, measured=turned_like(measured, model.values))


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
    """Of the object's geometry; without any, and with usable bodies, whose mode shapes have them, there is no such
    family (docs/decisions/symmetry-of-gains.md)."""
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

    def fit(self, data: GainData, trainer: Trainer) -> FittedGains:
        """Return the gain model, refined end to end, with its noise as measured by the refined modes."""
        model, used = self.solve(data)
        if levels := model.report["levels"]:
            data = data.divided(torch.tensor(levels, dtype=torch.float64))
        rates = {name: _PACE * getattr(data.config, name) for name in ("correction_rate", "noise_rate")}
        # A recording of another position than its label would pull the others' gains to its sound.
        taken, rate = replace(data.take(used.tolist()), config=replace(data.config, **rates)), data.train.sample_rate
        refined, steps = RefinedGains(model, data.modes.bank), math.ceil(data.config.steps / _PACE)
        run = trainer.run("fit", refined, taken, torch.arange(len(used)), warmup=0, steps=steps)
        measured = fit_gains(taken.train.sounds, run.trained, sample_rate=rate)
        reason = "as set" if data.config.damping == SHARED else "the only form of this gain model"
        damping = {"damping": SHARED, "validated": False, "damping_reason": reason}
        refined_model = refined.finished(run.order, along_phase(measured, data.phase[run.order]))
        return FittedGains(refined_model, run, taken.train, model.report | damping)

    def solve(self, data: GainData) -> tuple[MixtureGains, Int[Tensor, " used"]]:
        """Return the gain model as it follows from the data's gains, and the rows of the contacts it is fitted to.

        Raises FitError where one family alone was asked for, elastic, symmetry or visual, and it cannot be had.

        The thickness of a wall that is not known is searched for. Of several coarse bodies the most probable one is
        computed with finer elements, and the model is fitted again, until the most probable one is fine. Where it
        predicts little it is tried whether the object was held. Contacts that the others contradict are left out where
        these are predicted better from each other without them. Recordings without forces are divided by the levels
        that make their gains most probable, where that predicts better what they are. Last, the most probable body with
        its stiffness and density updated becomes one more hypothesis.
        """
        bodies, missing = self._usable_bodies(data)
        known = self.bodies if bodies else None
        given, every = data.train.directions, torch.arange(len(data.train))
        directional = bool(bodies) or (given is not None and bool(given.any()))
        groups = () if bodies or self.symmetries is None else groups_of(self.symmetries)
        self._expect_inputs(data, groups)
        units = PRESENT_UNIT if known is None else known.unit_ratios
        fit, thickness = Regression(data, self.kinds, sites_of(data, bodies), directional, groups, units), None
        if known is not None and known.searches_thickness:
            bodies, thickness = search_thickness(bodies, partial(fit.evidence, every), known.with_thicknesses)
        found = self._refined(fit, bodies)
        (outliers, credibility), evidence = fit.assess(found), dict[str, float]()
        tried = known is not None and _may_be_held(known, credibility)
        if tried and known is not None and found.best is not None and (modes := known.held(found.best)) is not None:
            rows = others(fit.sites, {each.row for each in outliers})
            held = fit.held(rows, found.best, modes, stated=bool(known.held_at))
            if held is not None:
                if known.held_at:
                    free = replace(held, elastic=modes.free, support=None)
                    evidence = dict(zip(("held", "free"), fit.evidence(rows, [held, free]), strict=True))
                # All modes have the support in common, so free bodies are no hypotheses any more.
                found = self._refined(fit, [held])
                outliers, credibility = fit.assess(found)
        if outliers:
            rows = others(fit.sites, {each.row for each in outliers})
            fewer = fit(rows, found.bodies)
            if predicts_better(fewer.model.leave_one_out(), found.model.leave_one_out()[rows], fit.measured.take(rows)):
                found = fewer
        levels = list[float]()
        if data.train.forces is None:
            fit, found, levels = _leveled(fit, found)
        updated = fit.updated(found.rows, found.best) if found.best is not None and self.update else None
        if updated is not None:
            found = fit(found.rows, [*found.bodies, updated])
        kept, credible = set(found.rows.tolist()), credibility is not None and credibility.credible
        contradicting = {data.train.names[each.row]: each.describe(data.train, with_body=credible) for each in outliers}
        report = {
            "bodies": sorted(found.entries, key=lambda each: -each["weight"]),
            "unavailable": {Elastic.kind: missing} if missing else {},
            "excluded": [name for row, name in enumerate(data.train.names) if row not in kept],
            "supports_tried": tried,
            "outliers": contradicting,
            "credibility": None if credibility is None else asdict(credibility) | {"credible": credible},
            "levels": levels,
            "support_evidence": evidence,
            "thickness": thickness,
        }
        return replace(found.model, report=report), found.rows

    def _refined(self, fit: Regression, bodies: Sequence[CandidateBody]) -> Solution:
        """Return the gain model of all contacts with the most probable body as fine as it can be had."""
        found = fit(torch.arange(len(fit.sites)), bodies)
        while (best := found.best) is not None and not best.fine and self.bodies is not None:
            fine = self.bodies.refined(best)
            if fine is best:
                break
            found = fit(found.rows, [fine if each is best else each for each in found.bodies])
        return found

    def _expect_inputs(self, data: GainData, groups: Sequence[Group]) -> None:
        """Raise FitError where one family alone was asked for and the symmetries or features that it needs are none."""
        if self.name == Symmetric.kind and not groups:
            wanted = "symmetries of the object's shape"
            raise FitError.expected(wanted, name=Symmetric.kind, advice="take another gain model")
        if self.name == Visual.kind and data.features.encoder == GEOMETRY:
            advice = "give --features, or take another gain model"
            raise FitError.expected("visual features", GEOMETRY, got="positions only", name=Visual.kind, advice=advice)

    def _usable_bodies(self, data: GainData) -> tuple[list[CandidateBody], str]:
        """Return the bodies that the contacts lie on, and why there are none."""
        if Elastic.kind not in self.kinds:
            return [], ""
        try:
            if self.bodies is None:
                advice = self.missing or "give its mesh"
                raise FitError.expected("the object's shape", name=Elastic.kind, advice=advice)
            points = self.bodies.bodies[0].elastic.points
            expect_on_body(data.train.contacts, points, names=data.train.names)
        except FitError as error:
            if self.name == Elastic.kind:
                raise
            return [], self.missing if self.bodies is None else str(error)
        return list(self.bodies.bodies), ""


def estimator_for(
    name: GainModelName,
    bodies: Callable[[], CandidateBodies],
    symmetries: Callable[[], Symmetries | None],
    *,
    log: Callable[[str], None] | None = None,
) -> GainEstimator:
    """Return the estimator of this name.

    `bodies` computes what may lie behind the object's surface. Where it raises an AvmsfError, `auto` has no elastic
    family, which `log` reports, and takes the `symmetries` of the object's shape. With `elastic` the error passes, and
    always that of a stated wall, support or number of degrees of freedom that cannot be (by the name `wall`, `held` or
    `dofs`).
    """
    if name == NETWORK:
        return Attention()
    if name != AUTO and name != Elastic.kind:
        return MixtureEstimator((name,), symmetries=symmetries() if name == Symmetric.kind else None)
    kinds = FAMILIES if name == AUTO else (name,)
    try:
        return MixtureEstimator(kinds, bodies())
    except AvmsfError as error:
        if name == Elastic.kind or error.name in ("wall", "dofs", "held"):
            raise
        if log is not None:
            log(f"no elastic mode shapes: {error}")
        return MixtureEstimator(kinds, missing=str(error), symmetries=symmetries())


def _may_be_held(bodies: CandidateBodies, credibility: Credibility | None) -> bool:
    """Return whether supports are tried: where they are asked for or stated, or the free body predicts little."""
    little = credibility is not None and credibility.gained < _PREDICTS
    return bodies.supports == "try" or bool(bodies.held_at) or (bodies.supports == "auto" and little)


def _leveled(fit: Regression, found: Solution) -> tuple[Regression, Solution, list[float]]:
    """Return the fit and gain model of the recordings over their most probable levels, and these; none if no better."""
    measured = fit.measured.take(found.rows)
    levels = torch.ones(len(fit.sites), dtype=torch.float64)
    levels[found.rows] = found.model.mixture.take(torch.nonzero(measured.informative).flatten()).levels()
    levels /= levels[found.rows].log().mean().exp()
    over = replace(fit, data=fit.data.divided(levels))
    leveled = over(found.rows, found.bodies)
    # Of recordings as they are: a sound of unknown force is rendered at level one.
    if predicts_better(leveled.model.leave_one_out(), found.model.leave_one_out(), measured):
        return over, leveled, levels.tolist()
    return fit, found, []
