"""Functions of place through scattered values: thin-plate splines, smoothed only as far as the values ask for it.

The least bent of all functions that pass the given values at given distances: a linear function of place plus, for
every site, a weight times r^2 log r, where the weights are orthogonal to all linear functions. The smoothing is a
number on the diagonal of its equations: zero passes through all values, infinity leaves the linear function. The error
at a site that is left out needs no second solution: it is the site's weight over the diagonal of the inverse.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.errors import EvaluationError

SMOOTHINGS = (0.0, *(10.0 ** (0.5 * step) for step in range(-10, 5)))
"""What is tried, for sites within a unit of length."""
_FLAT = 1e-3
"""Extent relative to the longest below which a direction is one of measuring errors alone."""
_ENOUGH = 2
"""How many times the sites that determine a linear function it takes for one to be fitted."""
_FEWEST_TO_SMOOTH = 16
"""Sites from which on leaving them out tells of noise."""


@dataclass(frozen=True, eq=False)
class Spline:
    """A function of place with one value or many."""

    middle: Float64[Tensor, "3"]
    """Middle of the sites, metres."""
    axes: Float64[Tensor, "3 dim"]
    """Principal axes of the sites along which they differ, over their longest extent."""
    sites: Float64[Tensor, "sites dim"]
    """Distinct places that values are known at, along the axes."""
    coefficients: Float64[Tensor, "terms values"]
    """Of the sites' functions, then of the constant and the coordinates."""
    bending: bool
    """Whether the sites' functions are r^2 log r, beside a linear function; else they are r, beside a constant."""
    smoothing: float
    """What the diagonal was given."""

    def at(self, contacts: Float[Tensor, "contacts 3"]) -> Float64[Tensor, "contacts values"]:
        """Return the values at places in metres."""
        places = (contacts.double() - self.middle) @ self.axes
        terms = torch.cat([_kernel(places, self.sites, self.bending), _drift(places, self.bending)], dim=1)
        return terms @ self.coefficients


def fit_spline(
    contacts: Float[Tensor, "contacts 3"],
    values: Float[Tensor, "contacts values"],
    *,
    importance: Float[Tensor, " values"],
) -> Spline:
    """Return the function through values at contacts in metres.

    Contacts in one place count as one with their mean values; directions in which they do not differ have no part.

    With fewer sites than twice what determines a linear function (eight in space, six in a plane) that function would
    run away beyond them: then the function is the biharmonic one, a constant and multiples of r, which does not. From
    16 sites on the values are smoothed: by the least of `SMOOTHINGS` whose error at sites left out in turn, summed over
    values by `importance`, is not larger than the best one's by more than that difference's standard error. Fewer sites
    tell by being left out how far apart they are rather than how noisy, and their values are taken as they are.

    Raises EvaluationError where there is no contact.
    """
    if len(contacts) == 0:
        raise EvaluationError("a spline was asked for without any contact; give at least one")
    places, owner = torch.unique(contacts.double(), dim=0, return_inverse=True)
    counts = torch.bincount(owner, minlength=len(places)).double()
    means = torch.zeros(len(places), values.shape[1], dtype=torch.float64).index_add(0, owner, values.double())
    means = means / counts[:, None]
    middle, axes = _frame(places)
    sites = (places - middle) @ axes
    bending = len(sites) >= _ENOUGH * (sites.shape[1] + 1)
    smoothings = SMOOTHINGS if len(sites) >= _FEWEST_TO_SMOOTH else SMOOTHINGS[:1]
    trials = [_solve(sites, means, bending, smoothing) for smoothing in smoothings]
    errors = torch.stack([(left_out.square() * importance.double()).sum(1) for _, left_out in trials])
    chosen = _least_needed(errors) if len(trials) > 1 else 0
    return Spline(middle, axes, sites, trials[chosen][0], bending, smoothings[chosen])


def _least_needed(errors: Float64[Tensor, "trials sites"]) -> int:
    """Return the first trial that no other is better than by more than the difference's standard error."""
    excess = errors - errors[errors.sum(1).argmin()]
    scatter = excess.std(1) * len(errors[0]) ** 0.5
    return int(torch.nonzero(excess.sum(1) <= scatter)[0, 0])


def _frame(places: Float64[Tensor, "sites 3"]) -> tuple[Float64[Tensor, "3"], Float64[Tensor, "3 dim"]]:
    middle = places.mean(0)
    _, _, rows = torch.linalg.svd(places - middle, full_matrices=False)
    along = (places - middle) @ rows.T
    extent = along.amax(0) - along.amin(0)
    longest = float(extent.max())
    return middle, rows[extent > _FLAT * longest].T / (longest or 1.0)


def _solve(
    sites: Float64[Tensor, "sites dim"], values: Float64[Tensor, "sites values"], bending: bool, smoothing: float
) -> tuple[Float64[Tensor, "terms values"], Float64[Tensor, "sites values"]]:
    """Return the coefficients, and the errors at sites that are left out in turn."""
    count = len(sites)
    drift = _drift(sites, bending)
    terms = drift.shape[1]
    kernel = _kernel(sites, sites, bending) + smoothing * torch.eye(count, dtype=torch.float64)
    bordered = torch.cat(
        [torch.cat([kernel, drift], dim=1), torch.cat([drift.T, drift.new_zeros(terms, terms)], dim=1)]
    )
    inverse = torch.linalg.inv(bordered)
    coefficients = inverse[:, :count] @ values
    diagonal = torch.diagonal(inverse)[:count, None]
    return coefficients, coefficients[:count] / diagonal


def _kernel(
    places: Float64[Tensor, "contacts dim"], sites: Float64[Tensor, "sites dim"], bending: bool
) -> Float64[Tensor, "contacts sites"]:
    # Not cdist, whose shortcut through products loses half the digits of short distances.
    distance = (places[:, None, :] - sites).square().sum(2).sqrt()
    return torch.special.xlogy(distance.square(), distance) if bending else distance


def _drift(places: Float64[Tensor, "contacts dim"], bending: bool) -> Float64[Tensor, "contacts terms"]:
    constant = torch.ones(len(places), 1, dtype=torch.float64)
    return torch.cat([constant, places], dim=1) if bending else constant
