"""The gain model of some contacts and candidate bodies, and what the gains say of these bodies and contacts."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from operator import itemgetter
from typing import Any

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf.features.feature_field import GEOMETRY
from avmsf.fem.candidate_bodies import CandidateBody
from avmsf.fem.elastic_modes import ElasticModes, HeldModes
from avmsf.fem.supports import FREE, FREE_PRIOR, STIFFNESS_RATIOS, Patch, Support
from avmsf.fem.updating import update
from avmsf.field.gains.data import GainData, gain_variance
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.fitting import MeasuredGains, WeighedFamily, fit_mixture, matched, total_evidence
from avmsf.field.gains.kernels import POSITIONAL, KernelFamily, Sites, Unstructured, Visual
from avmsf.field.gains.mixture import NOISE_SHARES
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.outliers import Credibility, Fit, Outlier, assess_contacts, predicts_better
from avmsf.field.gains.symmetry import Symmetric
from avmsf.mesh.points import farthest_points
from avmsf.symmetry.characters import Group

_MAX_SPREAD = 64
"""Contacts that a body is updated from, at most."""
_PLACES = 500
"""Points of the surface where the contacts that contradict the others may have been."""


@dataclass(frozen=True, eq=False)
class Solution:
    """The gain model of some contacts and bodies."""

    model: MixtureGains
    rows: Int[Tensor, " rows"]
    bodies: Sequence[CandidateBody]
    entries: Sequence[dict[str, Any]]
    """What the gains say of each body, as plain values: its posterior probability, mean over modes by their energy, the
    surface's most probable unit with it (empty for the present one), and the factor on its frequencies in that unit."""

    @property
    def best(self) -> CandidateBody | None:
        """The most probable body."""
        row = max(range(len(self.bodies)), key=lambda row: self.entries[row]["weight"], default=None)
        return None if row is None else self.bodies[row]


@dataclass(frozen=True, eq=False)
class Regression:
    """Fits families and bodies to some of the data's contacts."""

    data: GainData
    kinds: tuple[str, ...]
    sites: Sites
    """All contacts."""
    directional: bool
    """Whether directions are known, or a body says which way its surface faces."""
    groups: tuple[Group, ...]
    """Symmetries of the object's shape."""
    unit_ratios: Mapping[str, float]
    """Units that the surface may be in, as `CandidateBodies` have them."""

    @cached_property
    def measured(self) -> MeasuredGains:
        """The gains at all contacts, with the variance that background noise gives them."""
        bank = self.data.modes.bank
        return MeasuredGains(self.data.values, gain_variance(self.data), bank.frequency, bank.damping)

    def families(self, rows: Int[Tensor, " rows"]) -> list[KernelFamily]:
        """Return the families of these contacts that know of no body."""
        sites, size, features = self.sites.take(rows), self._size, self.data.features
        kinds = [kind for name, kind in POSITIONAL.items() if name in (Unstructured.kind, *self.kinds)]
        found: list[KernelFamily] = [kind(sites, size) for kind in kinds]
        if self.groups and Symmetric.kind in self.kinds:
            found.append(Symmetric(sites, size, self.groups, directional=self.directional))
        if Visual.kind in self.kinds and features.encoder != GEOMETRY:
            found.append(Visual(sites, size, features.points, features.features))
        return found

    def elastic(self, rows: Int[Tensor, " rows"], modes: ElasticModes) -> Elastic:
        """Return the family of these contacts and a body's modes."""
        return Elastic(self.sites.take(rows), self._size, modes, unit_ratios=tuple(self.unit_ratios.values()))

    def __call__(
        self,
        rows: Int[Tensor, " rows"],
        bodies: Sequence[CandidateBody],
        noise_shares: tuple[float, ...] = NOISE_SHARES,
    ) -> Solution:
        """Return the gain model of these contacts."""
        elastic, measured = [self.elastic(rows, body.elastic) for body in bodies], self.measured
        model = fit_mixture(
            [*self.families(rows), *elastic], measured.take(rows), self.data.features.points,
            directional=self.directional, noise_shares=noise_shares,
        )  # fmt: skip
        share = measured.energy / measured.energy.sum().clamp_min(torch.finfo(torch.float64).tiny)
        parts = zip(model.families, (model.shares() @ share).tolist(), strict=True)
        weights = {id(family.modes): part for family, part in parts if isinstance(family, Elastic)}
        units = ["", *list(self.unit_ratios)[1:]]
        entries = [
            {
                "body": body.name,
                "wall_thickness": body.thickness,
                "support": FREE if body.support is None else body.support.name,
                "support_stiffness": None if body.support is None else body.support.stiffness,
                "updating_nats": body.updated,
                "refined": body.fine,
                "weight": weights.get(id(each.modes), 0.0),
                "unit": units[each.unit],
                "frequency_factor": each.material_factor,
            }
            for body, each in zip(bodies, elastic, strict=True)
        ]
        return Solution(model, rows, bodies, entries)

    def evidence(self, rows: Int[Tensor, " rows"], bodies: Sequence[CandidateBody]) -> list[float]:
        """Return the log evidence of the gains of some contacts with each body by itself."""
        measured = self.measured.take(rows)
        others = [WeighedFamily.of(each, measured) for each in self.families(rows)]
        elastic = (WeighedFamily.of(self.elastic(rows, body.elastic), measured) for body in bodies)
        return [total_evidence([*others, each], measured) for each in elastic]

    def held(
        self, rows: Int[Tensor, " rows"], body: CandidateBody, modes: HeldModes, *, stated: bool
    ) -> CandidateBody | None:
        """Return a body on its most probable support, by the evidence of all modes; None where it is free.

        A `stated` support is all patches. Else all patches and all pairs of them are tried at one stiffness, then the
        best with one patch more for as long as that is more probable, then other stiffnesses. Where both bodies are far
        from the object, evidence between them means little: the held one also has to predict contacts left out better.
        """
        patches, count, scale = modes.patches, len(modes.patches), modes.stiffness_scale

        def most_probable(
            choices: Iterable[tuple[Patch, ...]], *ratios: float
        ) -> tuple[float, tuple[Patch, ...], CandidateBody]:
            """Return the most probable of choices of patches at ratios of stiffness: log probability, patches, body."""
            supports = [Support(choice, ratio * scale) for choice in choices for ratio in ratios]
            bodies = [CandidateBody(body.thickness, modes.on(each), fine=False, support=each) for each in supports]
            # Numbers of patches share the probability of being held alike, and so do stiffnesses.
            counts = [math.comb(count, len(each.patches)) * count * len(STIFFNESS_RATIOS) for each in supports]
            logs = [each - math.log(number) for each, number in zip(self.evidence(rows, bodies), counts, strict=True)]
            found = zip(logs, [each.patches for each in supports], bodies, strict=True)
            return max(found, key=itemgetter(0), default=(-math.inf, (), body))

        if stated:
            return most_probable([patches], *STIFFNESS_RATIOS)[2]
        typical, *others = STIFFNESS_RATIOS
        best = most_probable([each for size in (1, 2) for each in combinations(patches, size)], typical)
        while True:
            more = most_probable([(*best[1], patch) for patch in patches if patch not in best[1]], typical)
            if more[0] <= best[0]:
                break
            best = more
        best = max(best, most_probable([best[1]], *others), key=itemgetter(0))
        free = CandidateBody(body.thickness, modes.free, fine=False)
        if best[0] + math.log((1.0 - FREE_PRIOR) / FREE_PRIOR) <= self.evidence(rows, [free])[0]:
            return None
        new, old = (self(rows, [each]).model.leave_one_out() for each in (best[2], free))
        return best[2] if predicts_better(new, old, self.measured.take(rows)) else None

    def updated(self, rows: Int[Tensor, " rows"], body: CandidateBody) -> CandidateBody | None:
        """Return the body with its stiffness and density updated; None where that has no higher evidence."""
        if body.elastic.perturbations is None:
            return None
        # The cost goes with the cube of the number of contacts, and some far from each other say enough of the body.
        rows = rows[farthest_points(self.sites.points[rows], min(_MAX_SPREAD, len(rows))).sort().values]
        sites, measured = self.sites.take(rows), self.measured.take(rows)
        others = [WeighedFamily.of(family, measured) for family in self.families(rows)]
        found = update(
            body.elastic, sites.points, sites.directions, measured.frequency, measured.values.real,
            measured.informative.chunk(2)[0], lambda modes: matched(others, self.elastic(rows, modes), measured),
        )  # fmt: skip
        return None if found is None else replace(body, elastic=found[0], updated=found[1])

    def assess(self, found: Solution) -> tuple[list[Outlier], Credibility | None]:
        """Return what contradicts the other contacts, and how credible the most probable body is."""
        points, best = found.model.points, found.best
        places = found.model.sites(points[farthest_points(points, min(_PLACES, len(points)))])

        def fitted(bodies: list[CandidateBody]) -> Fit:
            return lambda rows, noise_shares: self(rows, bodies, noise_shares).model

        return assess_contacts(fitted([]), None if best is None else fitted([best]), self.sites, places, self.measured)

    @property
    def _size(self) -> float:
        return 2.0 * self.data.features.half_diagonal


def sites_of(data: GainData, bodies: Sequence[CandidateBody]) -> Sites:
    """Return the training impacts; unknown directions go straight into the body.

    Without a body they are that of the nearest impact whose direction is known, or all alike where none is.
    """
    points, given = data.train.contacts.double(), data.train.directions

    def otherwise(unknown: Float64[Tensor, "unknown 3"]) -> Float64[Tensor, "unknown 3"]:
        if bodies:
            return -bodies[0].elastic.normals(unknown)
        known = torch.zeros(len(points), dtype=torch.bool) if given is None else given.any(1)
        if given is None or not bool(known.any()):
            return torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(len(unknown), 3)
        nearest = (unknown[:, None] - points[known]).square().sum(2).argmin(1)
        return torch.nn.functional.normalize(given[known][nearest].double(), dim=1)

    return Sites.along(points, given, otherwise)
