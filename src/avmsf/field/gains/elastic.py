"""The elastic family: a measured mode's shape is a mixture of mode shapes of a nominal body that are near in frequency.

The object's body is not the nominal one: its thickness, material and supports differ. To first order a perturbation of
stiffness and mass mixes shape j into shape k in proportion to 1 / (lambda_k - lambda_j), lambda being squared angular
frequencies (Fox and Kapoor, AIAA Journal 6, 1968). So if a mode is shape k, perturbed by a relative amount tau,

    K = (1 - p) sum_j g_kj phi_j phi_j' + p R,   g_kj = 1 / (1 + (2 log(f_k / f_j) / tau)^2),

where phi_j is the component of shape j along the impacts, R a smooth kernel for what no shape of the basis has, and p
its share. Shapes nearer in frequency than the perturbation mix freely. Where shapes cannot be distinguished, a
broader profile serves, g_kj = exp(-log(f_k / f_j)^2 / 2 w^2) + 1/1000: whatever lies near in frequency.

Which shape a mode is follows from its gains and from its frequency f: given shape k and a factor c on all nominal
frequencies (the body's material and scale are not known), log f is normal about log(c f_k); under all other families it
is as dense as the body's shapes, by a power law. Its standard deviation is the same for half of the modes of a body,
one of several, and the others have any of these: so all modes together tell how exact the body's frequencies are, and
with one or two impacts these tell which shape each mode is. In weighing the factor a few modes are shapes whose
frequencies have nothing to do with theirs: poles that stand for how strong modes begin have the gains of these.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import ClassVar

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.material import factor_range
from avmsf.field.gains.kernels import KernelFamily, Sites, scaled, squared_exponential

PERTURBATIONS = (0.003, 0.01, 0.03, 0.1, 0.3)
"""Relative perturbations tau of stiffness and mass."""
WIDTHS = (0.05, 0.1, 0.2, 0.4)
"""Standard deviations w of the broad profiles, in log frequency."""
RESIDUALS = (0.03, 0.1, 0.3, 0.6)
"""Shares p of what no shape has."""
PROFILE_PRIOR = (0.56, 0.28, 0.1, 0.027, 0.003, 0.015, 0.004, 0.008, 0.007)
"""Typical share of the modes of a body with each of `PERTURBATIONS`, then of `WIDTHS`."""
RESIDUAL_PRIOR = (0.96, 0.04, 7e-4, 1e-4)
"""Typical share of the modes of a body with each of `RESIDUALS` (docs/decisions/few-impacts.md)."""
EQUAL_PRIOR = 0.2
"""Probability that a body is not typical, so that all profiles and remainders are equally probable."""
REACH = 0.15
"""Length of the remainder's kernel over the object's size."""
_PROFILES = len(PERTURBATIONS) + len(WIDTHS)
_FAR = 1e-3
"""Least weight of a shape in a broad profile."""
FREQUENCY_ERRORS = (0.01, 0.03, 0.08, 0.2)
"""Standard deviations of log frequency about the nominal one, equally probable."""
_EXCEPTIONS = 0.5
"""Share of the modes whose standard deviation is any of these, not that of the other modes."""
UNRELATED = 0.02
"""Share of the modes that are shapes whose frequency says nothing of theirs, in weighing factors."""
_IMPROBABLE = 1e-6
"""Probability of a factor, over the most probable one's, below which it is left out: all of them together change
probabilities by less than a thousandth."""
_AT_ONCE = 400_000
"""Numbers that are worked on at a time: few enough for a processor's cache."""
_MARGIN = 0.1
"""Log frequency by which the range of measured modes is widened at both ends."""
_NARROWEST = 0.1
"""Log frequency that the upper half of a body's shapes is taken to span at least, so that close ones say no more."""
_LOWEST, _HIGHEST = (math.log(each) / FREQUENCY_ERRORS[0] for each in factor_range())
FACTORS = torch.exp(torch.arange(math.ceil(_LOWEST), math.floor(_HIGHEST) + 1).double() * FREQUENCY_ERRORS[0])
"""Factors on the nominal frequencies that materials can have, in steps of the least error."""
_FACTOR_PRIOR = ((0.5, 0.0, 0.05), (0.15, -0.29, 0.1), (0.15, -1.4, 0.15), (0.2, 0.0, 0.8))
"""Probability, mean and standard deviation of the log factor, relative to aluminum. The square root of Young's modulus
over density lies within 4 % for glass, ceramics, iron, steel and aluminum, at .75 of it for wood, at .22 to .29 of it
for plastics; the last one is for what lies between them and for other thicknesses."""
UNIT_ODDS = 0.001
"""Probability of each other unit of the surface over the present one's, where none is stated. A strip clamped at both
ends and taken for free has frequencies that are 40 times as probable in feet."""


class Elastic(KernelFamily):
    """Mixtures of the mode shapes of one nominal body, interpolated in its elements."""

    kind: ClassVar[str] = "elastic"

    def __init__(
        self, reference: Sites, size: float, modes: ElasticModes, *, unit_ratios: Sequence[float] = (1.0,)
    ) -> None:
        """Set up from the body's shapes.

        `unit_ratios` are the possible true lengths over those that the shapes were computed with, which come first.
        """
        super().__init__(reference, size)
        ratios = torch.tensor(unit_ratios, dtype=torch.float64)[:, None]
        self.frequency_factors = (FACTORS / ratios).flatten()
        """Factors on the frequencies that are considered, of a body in each unit and of each material in a row."""
        terms = [
            math.log(weight / deviation) - 0.5 * ((torch.log(FACTORS) - mean) / deviation).square()
            for weight, mean, deviation in _FACTOR_PRIOR
        ]
        material = torch.log_softmax(torch.logsumexp(torch.stack(terms), dim=0), dim=0)
        odds = torch.tensor([1.0] + [UNIT_ODDS] * (len(ratios) - 1), dtype=torch.float64)
        density = torch.log(odds / odds.sum())[:, None] + material - math.log(len(FREQUENCY_ERRORS))
        self.factor_log_prior = density.flatten().repeat_interleave(len(FREQUENCY_ERRORS))
        """Log probability of each pair in `frequency_weights` before any measurement: units, the present one first, and
        materials as a mixture of normal distributions of the log factor."""
        # As a file keeps them, so that a field that was read renders what the saved one does.
        self.modes = replace(modes, shapes=modes.shapes.float().double(), perturbations=None)
        self.frequency_weights = torch.exp(self.factor_log_prior)
        """Probability of each pair of `frequency_factors` and `FREQUENCY_ERRORS`, the pairs of one factor in a row."""
        # Covariances ask for the same impacts several times in a row, and of all families that are taken of this one.
        self._along = lru_cache(maxsize=3)(lambda sites: self.modes.gains(sites.points, sites.directions))
        self._reach = torch.tensor([REACH * size], dtype=torch.float64)
        apart = torch.log(modes.frequency[:, None] / modes.frequency)
        # The number of shapes below a frequency grows with a power of it: that of the upper half of these.
        # A single one says nothing of it: nearly 0.
        half = (len(modes) + 1) // 2
        self._growth = max(math.log(len(modes) / half), 1e-6) / max(float(apart[-1, half - 1]), _NARROWEST)
        profiles = [1.0 / (1.0 + (2.0 * apart / tau).square()) for tau in PERTURBATIONS]
        profiles += [torch.exp(-0.5 * (apart / width).square()) + _FAR for width in WIDTHS]
        profile, diagonal = torch.stack(profiles), self._along(reference).square().T
        self._sizes = profile @ diagonal.mean(1)
        elastic = scaled(profile.flatten(0, 1), diagonal)
        share = torch.tensor(RESIDUALS, dtype=torch.float64)[None, :, None]
        both = [(1.0 - share) * elastic[:, None], share.expand(len(elastic), -1, 1)]
        self.shares = torch.cat(both, dim=2).flatten(0, 1)

    def diagonal(self, sites: Sites) -> Float64[Tensor, "basis sites"]:
        """Return the squared components of each shape, and ones."""
        return torch.cat([self._along(sites).square().T, torch.ones(1, len(sites), dtype=torch.float64)])

    def between(self, sites: Sites, others: Sites) -> Float64[Tensor, "kernels sites others"]:
        """Return the kernels between two sets of impacts, without a basis, which would be far larger."""
        one, other = self._along(sites), self.shares[:, :-1][:, None] * self._along(others)
        mixed = (one @ other.flatten(0, 1).T).reshape(len(one), *other.shape[:2]).transpose(0, 1)
        rest = squared_exponential(sites.points, others.points, self._reach)[0] * sites.cosine(others)
        return mixed + rest * self.shares[:, -1, None, None]

    def categories(self) -> Int[Tensor, " kernels"]:
        """Return one category for each profile and remainder: the shape that is its center has a prior of its own."""
        one = torch.arange(_PROFILES * len(RESIDUALS)).reshape(_PROFILES, 1, len(RESIDUALS))
        return one.expand(-1, len(self.modes), -1).flatten()

    def category_prior(self) -> Float64[Tensor, " categories"]:
        """Return the probability of each profile and remainder before any measurement; one or two impacts keep it."""
        typical = torch.outer(torch.tensor(PROFILE_PRIOR).double(), torch.tensor(RESIDUAL_PRIOR).double()).flatten()
        return (1.0 - EQUAL_PRIOR) * typical / typical.sum() + EQUAL_PRIOR / len(typical)

    def visibility(self) -> Float64[Tensor, " kernels"]:
        """Return the mean square of each center's mixture of shapes at the reference impacts over their mean.

        All shapes have the same modal mass: one of small components at all impacts would have to be excited far more
        than others to be measured.
        """
        ratio = (self._sizes / self._sizes.mean(1, keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)).flatten()
        share = torch.tensor(RESIDUALS, dtype=torch.float64)
        return ((1.0 - share) * ratio[:, None] + share).flatten()

    def log_prior(self, log_frequency: Float64[Tensor, " modes"]) -> Float64[Tensor, "kernels modes"]:
        """Return the log probability that a mode is each kernel's shape, times the density of its frequency if it is.

        `log_frequency` is that of frequencies in Hz; see `shape_log_prior`.
        """
        shared = self.shape_log_prior(log_frequency)[None, :, None]
        return shared.expand(_PROFILES, -1, len(RESIDUALS), -1).flatten(0, 2)

    def shape_log_prior(self, log_frequency: Float64[Tensor, " modes"]) -> Float64[Tensor, "shapes modes"]:
        """Return the log probability that a mode is each shape, times the density of its frequency if it is.

        Over the density of a mode that is no shape; averaged over factors and errors by `frequency_weights`.
        `log_frequency` is that of frequencies in Hz.
        """
        weights = self.frequency_weights.reshape(len(self.frequency_factors), -1)
        # A mode has its body's error or, as an exception, any.
        weights = (1.0 - _EXCEPTIONS) * weights + _EXCEPTIONS * weights.mean(1, keepdim=True)
        probable = torch.nonzero(weights.amax(1) > _IMPROBABLE * weights.max()).flatten()
        found = torch.full((len(self.modes), len(log_frequency)), -torch.inf, dtype=torch.float64)
        for rows, error, densities in self._densities(probable, log_frequency):
            weighed = densities.add_(weights[rows, error].log()[:, None, None])
            found = torch.logaddexp(found, torch.logsumexp(weighed, dim=0))
        return found

    def shape_evidence(self, evidence: Float64[Tensor, "kernels noises series"]) -> Float64[Tensor, "shapes series"]:
        """Return the log evidence of each shape as center, over profiles and remainders by their `category_prior`."""
        noises, shapes = evidence.shape[1], len(self.modes)
        prior = self.category_prior().log()[self.categories()][:, None, None]
        each = (evidence + prior).reshape(_PROFILES, shapes, len(RESIDUALS) * noises, -1).transpose(0, 1)
        return torch.logsumexp(each.flatten(1, 2), dim=1) - math.log(noises)

    @property
    def factor(self) -> float:
        """The most probable factor on the nominal frequencies, in the most probable unit."""
        return self.material_factor * float(self.frequency_factors[self.unit * len(FACTORS)] / FACTORS[0])

    @property
    def unit(self) -> int:
        """Row of the most probable one of the `unit_ratios`."""
        return int(self._factor_weights.sum(1).argmax())

    @property
    def material_factor(self) -> float:
        """The most probable factor that the body's material has in the most probable unit."""
        return float(FACTORS[self._factor_weights[self.unit].argmax()])

    def match(
        self, log_frequency: Float64[Tensor, " modes"], shape: Float64[Tensor, "shapes modes"]
    ) -> Float64[Tensor, "pairs modes"]:
        """Return the log density of each mode's frequency and gains for each pair of a factor and an error.

        `shape` is the log evidence of each shape over that of a mode that is no shape. A mode may also be a shape above
        the computed ones, whose gains say nothing: without them a factor that brings all computed shapes below the
        modes would cost nothing. All shapes within the range of the measured modes, computed or not, are equally
        probable. Densities are over that of a mode that is no shape: like the shapes above, these are as dense at a
        frequency as the body's shapes, by a power law. `log_frequency` is that of frequencies in Hz.
        """
        low, high = _range(log_frequency)
        nominal = torch.log(self.frequency_factors[:, None] * self.modes.frequency)
        top, inside = nominal[:, -1:], _inside(nominal, low, high)[:, None]
        # Numbers of shapes below the ends by the law; only those above the computed ones follow it.
        counts = len(self.modes) * torch.exp(self._growth * (torch.tensor([low, high], dtype=torch.float64) - top))
        total = (inside + counts.clamp_min(len(self.modes)).diff(dim=1)).clamp_min(1.0)
        beyond = torch.where(log_frequency > top, (counts.diff(dim=1) / total).log(), -torch.inf)
        found = torch.empty(len(nominal), len(FREQUENCY_ERRORS), len(log_frequency), dtype=torch.float64)
        for rows, error, densities in self._densities(torch.arange(len(nominal)), log_frequency):
            found[rows, error] = torch.logsumexp(densities.add_(shape), dim=1)
        # A mode has its body's error or, as an exception, any.
        exception = torch.logsumexp(found, dim=1, keepdim=True) + math.log(_EXCEPTIONS / len(FREQUENCY_ERRORS))
        known = torch.logaddexp(found + math.log(1.0 - _EXCEPTIONS), exception) + math.log(1.0 - UNRELATED)
        known = torch.logaddexp(known, self.unrelated(shape))
        return torch.logaddexp(known + (inside / total).log()[..., None], beyond[:, None]).flatten(0, 1)

    def unrelated(self, shape: Float64[Tensor, "shapes modes"]) -> Float64[Tensor, " modes"]:
        """Return the log density of modes that are any shape, but at another frequency; `shape` as in `match`."""
        return torch.logsumexp(shape, dim=0) + math.log(UNRELATED / len(shape))

    def _densities(
        self, factors: Int[Tensor, " some"], log_frequency: Float64[Tensor, " modes"]
    ) -> Iterator[tuple[Int[Tensor, " factors"], int, Float64[Tensor, "factors shapes modes"]]]:
        """Yield rows of a few factors, one of an error, and log probabilities of shapes times densities of modes.

        The density of a mode's log frequency is that if it is the shape, over that of a mode that is no shape.
        """
        # Shapes within the range of the measured modes are equally probable.
        low, high = _range(log_frequency)
        reach = self._growth * (high - low)
        law = self._growth * (log_frequency - high) + math.log(reach / -math.expm1(-reach) / (high - low))
        for rows in torch.split(factors, max(1, _AT_ONCE // (len(self.modes) * len(log_frequency)))):
            nominal = torch.log(self.frequency_factors[rows][:, None] * self.modes.frequency)
            prior = law + _inside(nominal, low, high).clamp_min(1.0).log()[:, None, None]
            square = (log_frequency - nominal[..., None]).square_()
            for row, error in enumerate(FREQUENCY_ERRORS):
                yield rows, row, square * (-0.5 / error**2) - (prior + math.log(error * math.sqrt(2.0 * math.pi)))

    @property
    def _factor_weights(self) -> Float64[Tensor, "units factors"]:
        return self.frequency_weights.reshape(-1, len(FACTORS), len(FREQUENCY_ERRORS)).sum(2)


def _inside(nominal: Float64[Tensor, "factors shapes"], low: float, high: float) -> Float64[Tensor, " factors"]:
    """Return the number of shapes between two log frequencies."""
    return ((nominal > low) & (nominal < high)).sum(1).double()


def _range(log_frequency: Float64[Tensor, " modes"]) -> tuple[float, float]:
    """Return the ends of the range of measured modes, widened."""
    return float(log_frequency.min()) - _MARGIN, float(log_frequency.max()) + _MARGIN
