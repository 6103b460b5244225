"""A sound field sampled at points of the surface: all that other programs need to synthesize impacts there.

And its real signed amplitudes, for formats in which all modes have one phase.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Complex64, Float, Float32, Float64, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf._utils.arrays import ArrayLike, as_floats, fibonacci_sphere
from avmsf.errors import ExportError
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import points_on_object
from avmsf.field.sound_field import SoundField
from avmsf.mesh.neighborhoods import read_neighborhoods
from avmsf.mesh.points import farthest_points, nearest_points
from avmsf.modal.modes import ForcePulse, common_phase, synthesize
from avmsf.modal.spectra import magnitude_stft

_POINTS_OF_NORMALS = 20_000
"""Points that tell how the surface lies; their neighbors are searched."""
_RENDER_BATCH = 32
"""Contacts rendered at once; bounds the memory."""
_DRAWN = 4
"""Candidates for each selected point: farthest point sampling of a million points takes too long."""


@dataclass(frozen=True, eq=False)
class SampledField:
    """Modal parameters of impacts at some points, perpendicular to the surface unless other directions are given.

    The sound of an average recorded impact at a point, over its force, is the sum over modes of the imaginary part of
    gain exp(-d t + 2 pi i f t), plus the noise: exp(-d t) (Re gain sin(2 pi f t) + Im gain cos(2 pi f t)).
    """

    points: Float[Tensor, "points 3"]
    """Contacts, object frame, meters."""
    normals: Float32[Tensor, "points 3"]
    """Outward unit normals at the contacts, or the opposites of given directions: impacts go against them."""
    frequency: Float64[Tensor, " modes"]
    """Hz, all below half the sample rate."""
    damping: Float64[Tensor, "*points modes"]
    """1/s; one row for each point if the damping depends on the contact, otherwise one vector for all."""
    gains: Complex64[Tensor, "points modes"]
    """Amplitudes of the sines, and of the cosines times i, in the unit of the training sounds."""
    noise: Float32[Tensor, " samples"]
    """Residual noise: the realization that `SoundField.render` adds without forces to sounds of this length."""
    sample_rate: float
    """Samples per second of the training sounds, Hz."""
    per_newton: bool = False
    """Whether forces are in newtons; otherwise force 1 is that of an average recorded impact."""
    background_force: float | None = None
    """Force of an average recorded impact, if the noise is background (`Residual.force`); None if it grows with it."""
    name: str = ""
    """Name of the object."""
    supporting: tuple[int, ...] = ()
    """Columns of the modes' tensors that are supporting poles, see `SoundField.is_mode`."""
    box: Float[Tensor, "corners 3"] | None = None
    """Lowest and highest corner of the object's own points, object frame, meters; None where only these are known."""

    @classmethod
    def of(
        cls,
        sound_field: SoundField,
        points: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        *,
        directions: ArrayLike | None = None,
        limit: int | None = None,
        samples: int | None = None,
    ) -> "SampledField":
        """Return the field at `points` (object frame, meters), by default at its own that lie on the object.

        More than `limit` points are reduced to evenly spread ones. `normals` are outward normals; by default those of
        the field's body, or without a body the opposites of the directions that the gains are of, or where these know
        none estimated from its points. `directions` are those of the impacts at given points, as in
        `SoundField.render`; one of length zero is against the normal. `samples` is the length of the noise, by default
        that of the training sounds. Raises `ExportError` for no points, points that are not finite, and a field without
        a mode below half the sample rate.
        """
        normals = None if normals is None else as_floats(normals, "normals")
        directions = None if directions is None else as_floats(directions, "directions")
        places = points_on_object(sound_field.gain_field) if points is None else as_floats(points, "points")
        _check_points(places, normals, limit)
        if limit is not None and len(places) > limit:
            rows = spread_rows(places, limit)
            places = places[rows]
            normals, directions = (None if each is None else each[rows] for each in (normals, directions))
        if normals is None:
            normals = sound_field.gain_field.normals(places)
        own, fitted = sound_field.gain_field.points.detach(), sound_field.gain_field.fitted
        if normals is None and isinstance(fitted, MixtureGains) and fitted.directional:
            # Without a body impacts go as the nearest recorded one, whatever lies around them.
            normals = -fitted.sites(places.double() / sound_field.gain_field.length).directions
        if normals is None:
            # Of all its points: a few do not tell how the surface lies.
            some = own[:: max(1, len(own) // _POINTS_OF_NORMALS)]
            normals = outward_normals(some)[nearest_points(some, places)[:, 0]]
        if directions is not None:
            normals = torch.where(directions.any(1, keepdim=True), -directions.double(), normals.double())
        audible = torch.nonzero(sound_field.audible).flatten()
        if not len(audible):
            wanted, advice = "1 or more below half the sample rate", "edit less, or fit the field again"
            raise ExportError.expected(wanted, 0, got="none", name="modes", advice=advice)
        known = sound_field.known(places, directions=directions)
        turn = torch.polar(torch.ones_like(sound_field.phase), sound_field.phase)
        return cls(
            places.detach(),
            torch.nn.functional.normalize(normals.float(), dim=1),
            sound_field.bank.frequency[audible],
            known.dampings(sound_field.bank.damping)[..., audible],
            (known.mean * turn)[:, audible].to(torch.complex64),
            sound_field.noise(samples).float(),
            sound_field.sample_rate,
            sound_field.origin.per_newton,
            sound_field.residual.force,
            sound_field.origin.capture,
            supporting_columns(sound_field),
            torch.stack([own.amin(0), own.amax(0)]),
        )

    @property
    def samples(self) -> int:
        """Length of the noise: that of the training sounds, unless another was asked for."""
        return len(self.noise)

    @property
    def extent(self) -> Float[Tensor, "places 3"]:
        """Places that span the object, meters: the corners of its box, or where it is not known the contacts."""
        return self.points if self.box is None else self.box

    @property
    def average_force(self) -> float:
        """Force of an average recorded impact, as far as it is known."""
        return self.background_force or 1.0

    @property
    def shared_damping(self) -> bool:
        """Whether the dampings are the same at all contacts."""
        return self.damping.ndim == 1

    @property
    def has_phases(self) -> bool:
        """Whether a mode starts otherwise than as a sine."""
        return bool(self.gains.imag.any())

    @property
    def power(self) -> Float64[Tensor, "points modes"]:
        """Squared magnitudes of the gains."""
        return self.gains.real.double().square() + self.gains.imag.double().square()

    @property
    def energy(self) -> Float64[Tensor, " points"]:
        """Energy of the modes over time of an impact of force 1, gain^2 / (4 d) summed."""
        return (self.power / (4.0 * self.damping)).sum(1)

    def __len__(self) -> int:
        return len(self.points)

    def nearest(self, places: Float[Tensor, "places 3"]) -> Int[Tensor, " places"]:
        """Return the row of the point nearest to each position (object frame, meters)."""
        return nearest_points(self.points, places)[:, 0]

    def spread(self, count: int) -> Int[Tensor, " chosen"]:
        """Return `count` rows, or all if there are fewer, by farthest point sampling."""
        return spread_rows(self.points, min(count, len(self)))

    def without_noise(self) -> "SampledField":
        """Return the field with its modes alone."""
        return replace(self, noise=torch.zeros_like(self.noise))

    def take(self, rows: Int[Tensor, " chosen"]) -> "SampledField":
        """Return the field at some of its points."""
        return replace(
            self,
            points=self.points[rows],
            normals=self.normals[rows],
            damping=self.damping if self.shared_damping else self.damping[rows],
            gains=self.gains[rows],
        )

    def render(
        self,
        rows: Int[Tensor, " contacts"],
        *,
        force: float | None = None,
        samples: int | None = None,
        pulse: ForcePulse | None = None,
    ) -> Float32[Tensor, "contacts samples"]:
        """Return the sounds of impacts at the points of some rows, as `SoundField.render` does.

        `samples` is the length, by default that of the noise, after whose end there is none.
        """
        length = self.samples if samples is None else samples
        added = torch.nn.functional.pad(self.noise, (0, max(0, length - self.samples)))[:length]
        parts = []
        for chosen in torch.split(rows, _RENDER_BATCH):
            modes = synthesize(
                self.gains[chosen],
                self.frequency,
                self.damping if self.shared_damping else self.damping[chosen],
                samples=length,
                sample_rate=self.sample_rate,
            )
            parts.append(modes if pulse is None else pulse.soften(modes, sample_rate=self.sample_rate))
        sounds = torch.cat(parts)
        if force is None:
            return sounds + added
        return force * sounds + (force if self.background_force is None else self.background_force) * added


def supporting_columns(sound_field: SoundField) -> tuple[int, ...]:
    """Return the indices of the supporting poles among the audible modes."""
    sounding = sound_field.is_mode[sound_field.audible]
    return tuple(torch.nonzero(~sounding).flatten().tolist())


def spread_rows(points: Float[Tensor, "points 3"], count: int) -> Int[Tensor, " chosen"]:
    """Return `count` rows of the points by farthest point sampling."""
    drawn = torch.arange(len(points))
    if len(points) > _DRAWN * count:
        drawn = torch.from_numpy(np.sort(np.random.default_rng(0).permutation(len(points))[: _DRAWN * count]))
    return drawn[farthest_points(points[drawn], count)]


def _check_points(
    places: Float[Tensor, "points 3"], normals: Float[Tensor, "normals 3"] | None, limit: int | None
) -> None:
    finite = bool(torch.isfinite(places).all()) and (normals is None or bool(torch.isfinite(normals).all()))
    if len(places) == 0 or not finite:
        wanted, got = "finite points of the object's surface", "NaN or infinity" if len(places) else "none"
        advice = "name a mesh or Gaussians of the object, or fit the field to features on its surface"
        raise ExportError.expected(wanted, len(places), got=got, name="points", advice=advice)
    if normals is not None and normals.shape != places.shape:
        raise ExportError.expected(f"one for each of {len(places)} points", len(normals), name="normals")
    if limit is not None and limit < 1:
        raise ExportError.expected("1 point or more", limit, name="limit")


_NEIGHBORS = 12
"""Neighbors in the graph along which the orientation is propagated."""


def outward_normals(points: Float[Tensor, "points 3"]) -> Float32[Tensor, "points 3"]:
    """Return outward unit normals of the surface on which points lie.

    Fitted planes have no orientation. It is propagated along the minimum spanning tree of the neighbor graph, weighted
    by the change of the normal (Hoppe et al. 1992), and each connected component is oriented so that the normals of its
    outermost points point outwards. The normals of very few points point away from their centroid.
    """
    places = points.detach().double().cpu().numpy()
    if len(places) <= _NEIGHBORS:
        offsets = places - places.mean(axis=0)
        length = np.linalg.norm(offsets, axis=1, keepdims=True)
        away = np.where(length > 0, offsets / np.maximum(length, np.finfo(float).tiny), [0.0, 0.0, 1.0])
        return torch.from_numpy(away).float()
    normals = read_neighborhoods(places, count=_NEIGHBORS).normals
    _, rows = cKDTree(places).query(places, k=_NEIGHBORS + 1)
    tails, heads = np.repeat(np.arange(len(places)), _NEIGHBORS), rows[:, 1:].reshape(-1)
    # Not zero for equal normals: a sparse graph has no edges of weight zero.
    bend = 1.0 - np.abs(np.einsum("nd,nd->n", normals[tails], normals[heads])) + 1e-9
    edges = np.stack([np.minimum(tails, heads), np.maximum(tails, heads)], axis=1)
    edges, first = np.unique(edges, axis=0, return_index=True)
    tree = minimum_spanning_tree(coo_matrix((bend[first], edges.T), shape=(len(places),) * 2).tocsr())
    count, part = connected_components(tree, directed=False)
    directions = fibonacci_sphere(128).numpy()
    for number in range(count):
        members = np.flatnonzero(part == number)
        order, parents = breadth_first_order(tree, members[0], directed=False)
        for row in order[1:]:
            if normals[row] @ normals[parents[row]] < 0:
                normals[row] *= -1.0
        outermost = members[np.argmax(places[members] @ directions.T, axis=0)]
        if np.einsum("vd,vd->", normals[outermost], directions) < 0:
            normals[members] *= -1.0
    return torch.from_numpy(normals).float()


def signed_amplitudes(field: SampledField) -> Float32[Tensor, "points modes"]:
    """Return a real amplitude of each mode at each point, without its phase.

    It is the magnitude of sine and cosine part, so that levels do not change, with the sign of the projection on the
    phase that is common to all points, so that it changes at the mode's nodal lines.
    """
    amplitude = field.gains.to(torch.complex128)
    phase = common_phase(amplitude)
    along = (amplitude * torch.polar(torch.ones_like(phase), -phase)).real
    return torch.where(along < 0, -amplitude.abs(), amplitude.abs()).float()


def shared_dampings(field: SampledField) -> Float64[Tensor, " modes"]:
    """Return one damping for each mode, 1/s: the mean over points, weighted by the mode's energy there."""
    if field.shared_damping:
        return field.damping
    total = field.power.sum(0)
    weights = torch.where(total > 0, field.power / total.clamp(min=1e-300), 1.0 / len(field))
    return (weights * field.damping).sum(0)


def approximation_error(
    field: SampledField, amplitude: Complex64[Tensor, "points modes"], damping: Float64[Tensor, "*points modes"]
) -> tuple[float, float]:
    """Return how far modes of amplitudes sine + i cosine, without noise, are from the field at a few points.

    The largest difference of samples, relative to the largest sample; and the mean difference of short-time magnitude
    spectra, dB, weighted by the field's energy.
    """
    rows = field.spread(8)
    rendered = replace(field.without_noise(), gains=amplitude, damping=damping).render(rows)
    reference = field.render(rows)
    peak = float(reference.abs().max())
    if peak == 0:
        return 0.0, 0.0
    # Windows of about 40 ms: the temporal resolution of hearing.
    size = max(4, 2 ** round(math.log2(0.04 * field.sample_rate)))
    found, expected = (magnitude_stft(each, fft_size=size, hop=size // 4) for each in (rendered, reference))
    # What is 60 dB below the largest magnitude, or more, does not count.
    floor, energy = 1e-3 * float(expected.max()), expected.square()
    difference = 20.0 * torch.log10((found + floor) / (expected + floor)).abs()
    return float((rendered - reference).abs().max()) / peak, float((energy * difference).sum() / energy.sum())
