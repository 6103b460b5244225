"""Functions of place through scattered values: thin-plate splines, smoothed only as far as the values ask for it.

The least bent of all functions that pass the given values at given distances: a linear function of place plus, for
every site, a weight times r^2 log r, where the weights are orthogonal to all linear functions. The smoothing is a
number on the diagonal of its equations: zero passes through all values, infinity leaves the linear function. The error
at a site that is left out needs no second solution: it is the site's weight over the diagonal of the inverse.

Two sites ever nearer to each other with values that differ make a slope that is ever steeper, and the function runs
away on all sides of them. So contacts nearer than hammers hit are one site with their values' mean, in which the noise
of as many blows is the less.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.errors import FitError

SMOOTHINGS = (0.0, *(10.0 ** (0.5 * step) for step in range(-10, 5)))
"""What is tried, for sites within a unit of length."""
NEAR = 0.01
"""Distance between contacts over the diagonal of the box around all, up to which they are one site.

A value at a site beside another counts for at most 17 times itself anywhere from there on (20 sites: 10 times), as it
does among sites that lie apart; at a tenth of that distance it would be 90 times, at a hundredth 600.
"""
_MEMORY = 4_000_000
"""Numbers of a batch of distances."""
_FLAT = 1e-3
"""Extent relative to the longest below which a direction is one of measuring errors alone."""
_ENOUGH = 2
"""How many times the sites that determine a linear function it takes for one to be fitted."""
_FEWEST_TO_SMOOTH = 16
"""Sites from which on leaving them out tells of noise."""


@dataclass(frozen=True, eq=False)
class SplineSites:
    """Places that values may be known at, and how values there spread; linear in the values, whatever they are."""

    contacts: Float64[Tensor, "contacts 3"]
    """Metres; those nearer to each other than `NEAR` count as one, between them and with their values' mean."""
    smoothing: float
    """What the diagonal of the equations is given, for a site of one contact."""

    @cached_property
    def _places(self) -> tuple[Float64[Tensor, "sites 3"], Float64[Tensor, "sites contacts"]]:
        """Distinct places, and the matrix that takes the mean of the values at each."""
        owner = places_of(self.contacts)
        members = (owner[None, :] == torch.arange(int(owner.max()) + 1)[:, None]).double()
        mean = members / members.sum(1, keepdim=True)
        return mean @ self.contacts, mean

    @cached_property
    def middle(self) -> Float64[Tensor, " 3"]:
        """Middle of the sites, metres."""
        return self._places[0].mean(0)

    @cached_property
    def axes(self) -> Float64[Tensor, "3 dim"]:
        """Principal axes of the sites along which they differ, over their longest extent."""
        centred = self._places[0] - self.middle
        _, _, rows = torch.linalg.svd(centred, full_matrices=False)
        along = centred @ rows.T
        extent = along.amax(0) - along.amin(0)
        longest = float(extent.max())
        return rows[extent > _FLAT * longest].T / (longest or 1.0)

    @cached_property
    def sites(self) -> Float64[Tensor, "sites dim"]:
        """Distinct places that values are known at, along the axes."""
        return (self._places[0] - self.middle) @ self.axes

    @cached_property
    def noise(self) -> Float64[Tensor, " sites"]:
        """What each site's diagonal is given: a mean of several values has as much less noise."""
        return self.smoothing / (self._places[1] > 0).sum(1).double()

    @property
    def bending(self) -> bool:
        """Whether the sites' functions are r^2 log r, beside a linear function; else they are r, beside a constant."""
        return len(self.sites) >= _ENOUGH * (self.sites.shape[1] + 1)

    @cached_property
    def inverse(self) -> Float64[Tensor, "terms terms"]:
        """Of the spline's equations: the sites' functions with the smoothing, bordered by the drift."""
        drift = _drift(self.sites, self.bending)
        terms = drift.shape[1]
        kernel = _kernel(self.sites, self.sites, self.bending)
        kernel = kernel + torch.diag(self.noise)
        border = torch.cat([drift.T, drift.new_zeros(terms, terms)], dim=1)
        return torch.linalg.inv(torch.cat([torch.cat([kernel, drift], dim=1), border]))

    def means(self, values: Float[Tensor, "contacts values"]) -> Float64[Tensor, "sites values"]:
        """Return the values at the sites, each the mean of its contacts'."""
        return self._places[1] @ values.double()

    def weights(self, places: Float[Tensor, "places 3"]) -> Float64[Tensor, "places contacts"]:
        """Return what each contact's value counts for at places in metres."""
        return self._terms(places) @ self.inverse[:, : len(self.sites)] @ self._places[1]

    def spread(self, places: Float[Tensor, "places 3"]) -> Float64[Tensor, " places"]:
        """Return the variance of a value at each place, given all sites', over that of the sites' functions' weights.

        A spline is the mean of a random field whose covariance is known but for a linear function (kriging).
        """
        terms = self._terms(places)
        quadratic = -((terms @ self.inverse) * terms).sum(1)
        return (quadratic if self.bending else -quadratic).clamp_min(0.0)

    def covariance(self, places: Float[Tensor, "places 3"]) -> Float64[Tensor, "places places"]:
        """Return how what is not known of values at places hangs together; `spread` on the diagonal.

        The error of a spline is a sum of values whose linear function is nought, so the kernel is a covariance for it.
        """
        count = len(self.sites)
        along = torch.cat([(places.double() - self.middle) @ self.axes, self.sites])
        known = self._terms(places) @ self.inverse[:, :count]
        error = torch.cat([torch.eye(len(places), dtype=torch.float64), -known], dim=1)
        kernel = _kernel(along, along, self.bending)
        noise = torch.cat([kernel.new_zeros(len(places)), self.noise])
        covariance = error @ (kernel + torch.diag(noise)) @ error.T
        return covariance if self.bending else -covariance

    def left_out(self, values: Float[Tensor, "contacts values"]) -> Float64[Tensor, "sites values"]:
        """Return the errors at sites whose values are left out in turn."""
        return self._coefficients(values)[: len(self.sites)] / self._diagonal[:, None]

    def field_variance(self, values: Float[Tensor, "contacts values"]) -> Float64[Tensor, " values"]:
        """Return the variance that `spread` is relative to, told by the errors at sites left out in turn."""
        weights = self._coefficients(values)[: len(self.sites)]
        return (weights.square() / self._diagonal.abs()[:, None]).mean(0)

    @property
    def _diagonal(self) -> Float64[Tensor, " sites"]:
        return torch.diagonal(self.inverse)[: len(self.sites)]

    def _coefficients(self, values: Float[Tensor, "contacts values"]) -> Float64[Tensor, "terms values"]:
        return self.inverse[:, : len(self.sites)] @ self.means(values)

    def _terms(self, places: Float[Tensor, "places 3"]) -> Float64[Tensor, "places terms"]:
        along = (places.double() - self.middle) @ self.axes
        batches = torch.split(along, 1 + _MEMORY // (1 + self.sites.numel()))
        kernel = torch.cat([_kernel(batch, self.sites, self.bending) for batch in batches])
        return torch.cat([kernel, _drift(along, self.bending)], dim=1)


@dataclass(frozen=True, eq=False)
class Spline:
    """A function of place with one value or many."""

    sites: SplineSites
    values: Float64[Tensor, "contacts values"]
    """Values at the sites' contacts."""

    def at(self, contacts: Float[Tensor, "contacts 3"]) -> Float64[Tensor, "contacts values"]:
        """Return the values at places in metres."""
        return self.sites.weights(contacts) @ self.values


def fit_spline(
    contacts: Float[Tensor, "contacts 3"],
    values: Float[Tensor, "contacts values"],
    *,
    importance: Float[Tensor, " values"],
) -> Spline:
    """Return the function through values at contacts in metres.

    Contacts in one place, or nearer than `NEAR`, count as one with their mean values; directions in which they do not
    differ have no part.

    With fewer sites than twice what determines a linear function (eight in space, six in a plane) that function would
    run away beyond them: then the function is the biharmonic one, a constant and multiples of r, which does not. From
    16 sites on the values are smoothed: by the least of `SMOOTHINGS` whose error at sites left out in turn, summed over
    values by `importance`, is not larger than the best one's by more than that difference's standard error. Fewer sites
    tell by being left out how far apart they are rather than how noisy, and their values are taken as they are.

    Raises FitError where there is no contact.
    """
    if len(contacts) == 0:
        raise FitError("a spline was asked for without any contact; give at least one")
    places = contacts.double()
    few = len(SplineSites(places, 0.0).sites) < _FEWEST_TO_SMOOTH
    trials = [SplineSites(places, smoothing) for smoothing in (SMOOTHINGS[:1] if few else SMOOTHINGS)]
    errors = torch.stack([(trial.left_out(values).square() * importance.double()).sum(1) for trial in trials])
    return Spline(trials[0 if few else _least_needed(errors)], values.double())


def places_of(contacts: Float64[Tensor, "contacts 3"]) -> Int[Tensor, " contacts"]:
    """Return the number of each contact's place, from 0 on; no two contacts of one are farther apart than `NEAR`."""
    places, owner = torch.unique(contacts, dim=0, return_inverse=True)
    distance = NEAR * float((places.amax(0) - places.amin(0)).norm())
    near = np.unique(cKDTree(places.numpy()).query_pairs(distance, output_type="ndarray"))
    if not len(near):
        return owner
    # Complete linkage: along a row of contacts each near to the next, sites would else grow without end.
    groups = fcluster(linkage(places[near].numpy(), "complete"), distance, criterion="distance")
    first = np.arange(len(places))
    first[near] = near[np.unique(groups, return_index=True)[1][groups - 1]]
    return torch.unique(torch.from_numpy(first), return_inverse=True)[1][owner]


def _least_needed(errors: Float64[Tensor, "trials sites"]) -> int:
    """Return the first trial that no other is better than by more than the difference's standard error."""
    excess = errors - errors[errors.sum(1).argmin()]
    scatter = excess.std(1) * len(errors[0]) ** 0.5
    return int(torch.nonzero(excess.sum(1) <= scatter)[0, 0])


def _kernel(
    places: Float64[Tensor, "contacts dim"], sites: Float64[Tensor, "sites dim"], bending: bool
) -> Float64[Tensor, "contacts sites"]:
    # Not cdist, whose shortcut through products loses half the digits of short distances.
    distance = (places[:, None, :] - sites).square().sum(2).sqrt()
    return torch.special.xlogy(distance.square(), distance) if bending else distance


def _drift(places: Float64[Tensor, "contacts dim"], bending: bool) -> Float64[Tensor, "contacts terms"]:
    constant = torch.ones(len(places), 1, dtype=torch.float64)
    return torch.cat([constant, places], dim=1) if bending else constant
