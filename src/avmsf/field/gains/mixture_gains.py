"""The gain model: kernel families weighed by evidence, and their predictions anywhere on the object."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Complex128, Float32, Float64, Int
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf._utils.arrays import short_repr
from avmsf._utils.tensor_files import TensorReader
from avmsf._utils.text import RecordError, count_of, like
from avmsf.capture.impacts import places_of
from avmsf.fem.elastic_modes import ElasticModes, mode_sizes, mode_tensors, restored_modes
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.kernels import POSITIONAL, Family, KernelFamily, Sites, Visual
from avmsf.field.gains.mixture import NOISE_SHARES, KernelMixture, Predictions, Statistic, mean_magnitude
from avmsf.field.gains.model import Directions, GainModel, Gains, Points, complex_of, series_of
from avmsf.field.gains.symmetry import Symmetric
from avmsf.symmetry.characters import Group

NEIGHBORS = 3
"""Nearest recordings that are averaged, as in the paper's baseline."""
_MEMORY = 2_000_000
"""Covariances between places and contacts that are held at once, over all kernels: near a processor's cache."""
_COVARIANCE_KERNELS = 8
"""Kernels whose covariances between places are held at once."""
_OF_OBJECT = {Elastic.kind: "bodies", Symmetric.kind: "symmetries", Visual.kind: "features"}
"""Families that know something of the object, and the entry of the record with its size."""


@dataclass(frozen=True, eq=False)
class MixtureGains(GainModel):
    """Gains as a Gaussian process over several kernel families, each kernel weighed by its evidence."""

    __repr__ = short_repr

    points: Float32[Tensor, "points 3"]
    """Points of the object's surface, object frame, meters."""
    training: Sites
    """The impacts that the gains are known at."""
    families: tuple[KernelFamily, ...]
    """At least one, each with the kernels that have a weight."""
    mixture: KernelMixture
    """Of these kernels in this order; its series are the real parts of all modes' gains, then the imaginary ones."""
    directional: bool
    """Whether directions of impacts are known, or a body says which way its surface faces."""
    spread_share: float = 0.0
    """How much of the deviation within hypotheses the magnitudes of rendered gains take into account, 0 to 1."""
    measured: Complex128[Tensor, "contacts modes"] | None = None
    """The gains of the field's own modes in the recordings, by which the model judges itself; None for `values`."""
    report: dict[str, Any] = field(default_factory=dict)
    """What the fit found, as plain values; not saved."""

    kind: ClassVar[str] = "mixture"

    @property
    def contacts(self) -> Float64[Tensor, "contacts 3"]:
        """Their places, meters."""
        return self.training.points

    @property
    def values(self) -> Complex128[Tensor, "contacts modes"]:
        """The gains there."""
        return complex_of(self.mixture.values)

    @property
    def place_count(self) -> int:
        """How many separate places the contacts are in."""
        return int(self.places.max()) + 1

    @property
    def places(self) -> Int[Tensor, " contacts"]:
        """Number of each contact's place, from 0 on."""
        return places_of(self.contacts)

    def sites(self, contacts: Points, directions: Directions = None) -> Sites:
        """Return impacts; without a direction, or with one of length zero, they go straight into the body.

        Where there is no body they go as the nearest training impact does. Where the model knows nothing of directions,
        all are alike.
        """
        return Sites.along(contacts.double(), directions if self.directional else None, self._straight)

    def nearest(
        self, sites: Sites, others: Int[Tensor, " sites"] | None = None
    ) -> tuple[Int[Tensor, "sites near"], Float64[Tensor, "sites near"]]:
        """Return the rows of the three nearest training impacts and the sign of each, by `Sites.nearest`.

        `others` is the place number of each site, whose own training impacts are left out.
        """
        own = None if others is None else others[:, None] == self.places
        return sites.nearest(self.training, size=self.families[0].size, count=NEIGHBORS, excluded=own)

    @property
    def body(self) -> ElasticModes | None:
        """The elastic modes of the first body that the gains know, which gives the surface; None without one.

        Predictions are means over all bodies, whose surfaces are alike but for the resolution of their elements.
        """
        return next((each.modes for each in self._of(Elastic)), None)

    def predict(self, points: Points, directions: Directions = None) -> Gains:
        """Return the mean gains of impacts, see `sites`."""
        return Gains.of(*self._average(self.sites(points, directions), lambda mean, _: mean))

    def point_estimate(self, points: Points, directions: Directions = None) -> Gains:
        """Return the mean magnitudes of the gains, as far as `spread_share` goes, with the signs of the mean gains."""

        def magnitude(mean: Tensor, variance: Tensor) -> Tensor:
            certain = mean.abs()
            return certain.lerp(mean_magnitude(mean, variance), self.spread_share) if self.spread_share else certain

        found, mean = self._average(self.sites(points, directions), magnitude, lambda mean, _: mean)
        return Gains.of(found.copysign(mean))

    def posterior(self, points: Points, directions: Directions = None) -> Gains:
        """Return the mean gains with the standard deviation of both parts, without the noise of a measurement."""
        sites = self.sites(points, directions)
        mean, square = self._average(sites, lambda mean, _: mean, lambda mean, variance: mean.square() + variance)
        return replace(Gains.of(mean), std=_parts((square - mean.square()).clamp_min(0.0).sqrt()).float())

    def noise(self) -> Float64[Tensor, "modes 2"]:
        """Return the standard deviation of the noise in both parts of a measured gain."""
        return _parts(self.mixture.standard_error()[None])[0]

    def leave_one_out(self) -> Complex128[Tensor, "contacts modes"]:
        """Return the gains at each contact as the measured ones at all other places predict them."""
        return complex_of(self._left_out.mean)

    def left_out_estimate(self, share: float) -> Gains:
        """Return `point_estimate` at each contact from the measured gains at all other places, for a spread share."""
        left = self._left_out
        return Gains.of(left.of_means.lerp(left.magnitude, share).copysign(left.mean))

    def standardized_errors(self) -> Float64[Tensor, "contacts modes 2"]:
        """Return the leave-one-place-out errors of the measured gains over their predicted standard deviations.

        NaN for parts of modes without any gains.
        """
        left, measured = self._left_out, self.values if self.measured is None else self.measured
        scores = (series_of(measured) - left.mean) / left.deviation
        power = self.mixture.values.square().sum(0)
        return _parts(torch.where(power > 0, scores, torch.nan))

    def covariances(
        self, contacts: Float64[Tensor, "places 3"], directions: Float64[Tensor, "places 3"] | None
    ) -> Iterator[tuple[int, Float64[Tensor, "places places"], float]]:
        """Yield each mode, its gains' posterior covariance at places, and the noise variance of one more gain.

        Modes come in no order. By the mode's most probable hypothesis; both are sums over the two parts of the gains.
        """
        sites, weights, values = self.sites(contacts, directions), self.mixture.weights, self.mixture.values
        best = (weights * values.square().sum(0)).reshape(*weights.shape[:2], 2, -1).sum(2).flatten(0, 1).argmax(0)
        rows, shares = best // weights.shape[1], best % weights.shape[1]
        used, place = torch.unique(rows, return_inverse=True)
        # Some at a time: the kernels of all modes between many places would be the largest tensor of a fit.
        for first in range(0, len(used), _COVARIANCE_KERNELS):
            kernels = used[first : first + _COVARIANCE_KERNELS]
            own, cross = (
                [kernel for family in self.families_of(kernels) for kernel in family.between(sites, others)]
                for others in (sites, self.training)
            )
            for mode in torch.nonzero(torch.isin(rows, kernels)).flatten().tolist():
                row, noise = int(place[mode]) - first, float(self.mixture.noise_variance[shares[mode], mode])
                known = self.mixture.kernels[rows[mode]] + noise * torch.eye(len(values)).double()
                root = torch.linalg.cholesky(known)
                series = torch.tensor([mode, mode + len(best)])
                half, parts = (
                    torch.linalg.solve_triangular(root, each, upper=False) for each in (cross[row].T, values[:, series])
                )
                quadratic, every = parts.square().sum(0), torch.arange(len(values))
                size = float(self.mixture.scale(quadratic, noise, series, every).sum())
                yield mode, size * (own[row] - half.T @ half), size * noise

    def families_of(self, rows: Int[Tensor, " rows"]) -> Iterator[KernelFamily]:
        """Yield the families of some of the mixture's kernels, given by their sorted rows, with these kernels alone."""
        for family, first in zip(self.families, accumulate(map(len, self.families), initial=0), strict=False):
            own = rows[(rows >= first) & (rows < first + len(family))] - first
            if len(own):
                yield family.take(own)

    def with_values(self, values: Complex128[Tensor, "contacts modes"]) -> "MixtureGains":
        """Return the model of other gains at the same contacts, its hypotheses weighed as before."""
        return replace(self, mixture=replace(self.mixture, values=series_of(values)))

    def take(self, modes: Int[Tensor, " modes"]) -> "MixtureGains":
        """Return the model of some modes, in the given order."""
        series = torch.cat([modes, modes + self.mixture.values.shape[1] // 2])
        measured = None if self.measured is None else self.measured[:, modes]
        return replace(self, mixture=self.mixture.take(series), measured=measured)

    def without(self, contacts: Bool[Tensor, " contacts"]) -> "MixtureGains":
        """Return the model without some contacts, its hypotheses weighed as before."""
        kept = torch.nonzero(~contacts).flatten()
        measured = None if self.measured is None else self.measured[kept]
        kernels, values = self.mixture.kernels[:, kept[:, None], kept], self.mixture.values[kept]
        training = self.training.take(kept)
        mixture = replace(self.mixture, kernels=kernels, values=values, repetitions=training.repetitions())
        return replace(self, training=training, mixture=mixture, measured=measured)

    def shares(self) -> Float64[Tensor, "families modes"]:
        """Return the posterior probability of each family: mean over both parts of each mode, by their energy."""
        power = self.mixture.values.square().sum(0).reshape(2, -1).clamp_min(torch.finfo(torch.float64).tiny)
        rows = torch.split(self.mixture.weights.sum(1), list(map(len, self.families)))
        return torch.stack([(each.sum(0).reshape(2, -1) * power / power.sum(0)).sum(0) for each in rows])

    def record(self) -> dict[str, Any]:
        """Return the sizes and the families' names."""
        contacts, modes = self.values.shape
        return {
            "points": len(self.points),
            "contacts": contacts,
            "modes": modes,
            "directional": self.directional,
            "spread_share": self.spread_share,
            "families": [family.kind for family in self.families],
            "kernels": list(map(len, self.families)),
            "bodies": [mode_sizes(family.modes) for family in self._of(Elastic)],
            "symmetries": [[list(group.characters.shape) for group in family.groups] for family in self._of(Symmetric)],
            "features": [family.features.shape[1] for family in self._of(Visual)],
        }

    def tensors(self) -> dict[str, Tensor]:
        """Return the contacts, the gains there, the weights, and what families know of the object."""
        named = {
            "points": self.points,
            "contacts": self.training.points,
            "directions": self.training.directions,
            "object_size": torch.tensor([family.size for family in self.families], dtype=torch.float64),
            "values": torch.view_as_real(self.values),
            "measured": torch.view_as_real(self.values if self.measured is None else self.measured),
            "noise_floor": self.mixture.floor,
            "kernels": torch.cat([family.kept for family in self.families]),
            "weights": self.mixture.weights,
        }
        for family in self._of(Visual):
            named["features"] = family.features
        for row, group in enumerate(group for family in self._of(Symmetric) for group in family.groups):
            named |= {f"groups.{row}.{name}": getattr(group, name) for name in ("motions", "characters")}
        for row, modes in enumerate(family.modes for family in self._of(Elastic)):
            named |= {f"bodies.{row}.{name}": each for name, each in mode_tensors(modes).items()}
        return named

    @classmethod
    def restore(cls, record: Mapping[str, Any], read: TensorReader) -> "MixtureGains":
        """Return the model."""
        points, contacts, modes = (count_of(record[name], name) for name in ("points", "contacts", "modes"))
        # Files of earlier versions have none: their fields were chosen with each hypothesis's mean alone.
        directional, share = like(record["directional"], True, "directional"), record.get("spread_share", 0.0)
        if not 0.0 <= like(share, 0.0, "spread_share") <= 1.0:
            raise RecordError.expected("0 to 1", share, name="spread_share")
        training = Sites(read("contacts", contacts, 3), read("directions", contacts, 3))
        places = read("points", points, 3, dtype=torch.float32)
        families, kernels = _restored_families(record, read, training, places)
        floor, weights = read("noise_floor", 2 * modes), read("weights", len(kernels), len(NOISE_SHARES), 2 * modes)
        # Values that no fit leaves would fail only when gains are asked for.
        for name, each in (("noise_floor", floor), ("weights", weights)):
            if (least := float(each.min())) < 0:
                raise RecordError.expected("values of 0 or more", least, got=f"{least:g}", name=name)
        values, measured = (
            torch.view_as_complex(read(name, contacts, modes, 2).contiguous()) for name in ("values", "measured")
        )
        mixture = KernelMixture(kernels, series_of(values), floor, weights, repetitions=training.repetitions())
        return cls(places, training, families, mixture, directional, share, measured)

    def _of(self, kind: type[Family]) -> list[Family]:
        """Return the families of a kind."""
        return [each for each in self.families if isinstance(each, kind)]

    def _straight(self, points: Float64[Tensor, "points 3"]) -> Float64[Tensor, "points 3"]:
        """Return directions straight into the body, or without one those of the nearest training impacts."""
        outward = self.normals(points) if self.directional else None
        if outward is not None:
            return -outward
        near = cKDTree(self.contacts.numpy()).query(points.numpy())[1]
        return self.training.directions[torch.from_numpy(near)]

    @cached_property
    def _left_out(self) -> Predictions:
        """Of the measured gains: those that were refined end to end have seen the recordings that are left out."""
        mixture = self.mixture if self.measured is None else replace(self.mixture, values=series_of(self.measured))
        return mixture.leave_out(self.places)

    def _average(self, sites: Sites, *statistics: Statistic) -> list[Float64[Tensor, "sites series"]]:
        """Return the means over hypotheses of statistics of gains, in batches whose covariances fit the memory."""
        size, parts = max(1, _MEMORY // (len(self.mixture.kernels) * len(self.contacts))), []
        for rows in torch.split(torch.arange(len(sites)), size):
            some = sites.take(rows)
            cross = torch.cat([family.between(some, self.training) for family in self.families])
            own = torch.cat([family.own(some) for family in self.families])
            parts.append(self.mixture.average(cross, own, *statistics))
        return [torch.cat(each) for each in zip(*parts, strict=True)]


def _parts(series: Float64[Tensor, "contacts series"]) -> Float64[Tensor, "contacts modes 2"]:
    return torch.view_as_real(complex_of(series))


def _restored_families(
    record: Mapping[str, Any], read: TensorReader, training: Sites, points: Float32[Tensor, "points 3"]
) -> tuple[tuple[KernelFamily, ...], Float64[Tensor, "kernels contacts contacts"]]:
    """Return the families of a record, each with its kept kernels, and these among the training impacts."""
    kinds, bodies = (like(record[name], [], name) for name in ("families", "bodies"))
    counts = [count_of(each, "kernels") for each in like(record["kernels"], [], "kernels")]
    known = (*POSITIONAL, *_OF_OBJECT)
    if not set(kinds) <= set(known) or len(kinds) != len(counts):
        raise RecordError.expected(f"{len(counts)} of {', '.join(known)}", kinds, name="families")
    for kind, name in _OF_OBJECT.items():
        given = len(like(record[name], [], name))
        if given != kinds.count(kind) or (kind != Elastic.kind and given > 1):
            raise RecordError.expected(f"{kinds.count(kind)} as in families", given, name=name)
    modes = iter([restored_modes(each, read.within(f"bodies.{row}.")) for row, each in enumerate(bodies)])

    def family_of(kind: str, size: float) -> KernelFamily:
        if kind == Elastic.kind:
            return Elastic(training, size, next(modes))
        if kind == Symmetric.kind:
            groups = []
            for row, (characters, order) in enumerate(record["symmetries"][0]):
                sizes, part = (count_of(characters, "characters"), count_of(order, "motions")), f"groups.{row}."
                groups.append(Group(read(f"{part}motions", sizes[1], 3, 4), read(f"{part}characters", *sizes)))
            return Symmetric(training, size, groups, directional=record["directional"])
        if kind == Visual.kind:
            dim = count_of(record["features"][0], "features")
            return Visual(training, size, points, read("features", len(points), dim, dtype=torch.float32))
        return POSITIONAL[kind](training, size)

    sizes = read("object_size", len(kinds))
    if (least := float(sizes.min())) <= 0:
        raise RecordError.expected("values above 0", least, got=f"{least:g}", name="object_size")
    families, kernels = [], []
    kept = torch.split(read("kernels", sum(counts), dtype=torch.int64), counts)
    for kind, size, rows in zip(kinds, sizes.tolist(), kept, strict=True):
        family, ends = family_of(kind, size), (int(rows.min()), int(rows.max()))
        if not 0 <= ends[0] <= ends[1] < len(family):
            raise RecordError.expected(f"0 to {len(family) - 1}", ends, name=f"kept {kind} kernels")
        families.append(family.take(rows))
        # Of all of them, as in the fit: of some the rounding differs.
        kernels.append(family.kernels()[rows])
    return tuple(families), torch.cat(kernels)
